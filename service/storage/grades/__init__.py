"""Filtered and smoothed attitudes in the records."""
