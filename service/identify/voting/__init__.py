"""Fink & Shoup's STARID steps: pair tests, match groups, votes."""
