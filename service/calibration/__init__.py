"""Calibration of trackers from identified stars of many batches: alignment, distortion, time."""
