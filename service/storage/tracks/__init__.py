"""Tracks of points that no catalog star explains: what is read for them, and their records."""
