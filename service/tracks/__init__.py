"""Tracks of moving objects: observed points without a catalog star, linked over batches."""
