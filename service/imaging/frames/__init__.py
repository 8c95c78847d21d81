"""Frames from image files: FITS, TIFF, PNG, JPEG, BMP, raw files and numpy arrays."""
