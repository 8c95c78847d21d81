"""Readers of frames from files: FITS, TIFF, PNG, JPEG, GIF, BMP, raw files and numpy arrays."""
