"""Comparison of two versions of the service by sending both the same requests (`__main__`)."""
