"""Blind solution: attitude, lens and stars of a picture without any prior knowledge."""
