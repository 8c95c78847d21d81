"""Centroids of stars with predicted errors, by four methods."""
