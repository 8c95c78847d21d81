"""Indexes of the whole sky, for searches without an a priori attitude."""
