"""Tracks of moving objects: observed points without a catalog star, linked over batches."""

from service.feature import Feature

FEATURE = Feature("tracks", __name__, ("kernels", "part", "command", "routes", "pages"))
