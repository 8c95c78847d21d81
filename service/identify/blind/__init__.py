"""Blind solver: attitude and lens of a picture without any prior knowledge."""
