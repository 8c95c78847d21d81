"""Indexes of the whole sky, for searches without a priori attitude."""
