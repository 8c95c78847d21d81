"""Tracks: points that no catalog star explains, linked over batches."""

from service.feature import Feature

FEATURE = Feature("tracks", __name__, ("part", "command", "routes", "panels"))
