"""Observations: the batch, its text forms, and its calibration to body vectors at one epoch."""
