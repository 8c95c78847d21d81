"""Observations: batches of stars, file formats, and conversion to body vectors."""
