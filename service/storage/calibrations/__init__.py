"""Calibrations in the records: what was found, and what was adopted of it."""
