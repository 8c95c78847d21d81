"""Frames of star trackers: submission, record, simulation."""
