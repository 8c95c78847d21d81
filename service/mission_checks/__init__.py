"""Checks of a mission file: its settings, and the stars and pairs of its zones."""
