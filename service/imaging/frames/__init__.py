"""Frames from image files: FITS, TIFF, PNG, JPEG, BMP and numpy arrays."""
