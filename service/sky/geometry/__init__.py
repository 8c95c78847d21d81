"""Indexes of stars, pairs and triangles by position and by separation."""
