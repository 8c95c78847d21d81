"""Calibrations of a spacecraft's trackers from recorded batches."""
