"""The attitude and the lens of a picture of which neither is known."""
