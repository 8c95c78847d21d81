"""Advice on the settings of a mission from recorded batches."""

from service.feature import Feature

FEATURE = Feature("advice", __name__, ("part", "command", "routes", "pages"))
