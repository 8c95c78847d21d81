"""Conversion of scanning trackers' counts and crossing times to measured angles with sigmas."""
