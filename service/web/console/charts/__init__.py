"""Geometry of the console's pictures: star fields, labels and sparklines, in pixels."""
