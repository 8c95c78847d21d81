"""Tracks of observed points that no catalog star explains, linked over the batches of a stretch."""
