"""Observations: batches of observed stars, their file formats, and their conversion to body
vectors.
"""
