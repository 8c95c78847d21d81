"""Frames from image files: FITS, TIFF, PNG, JPEG, GIF, BMP, raw files and numpy arrays."""
