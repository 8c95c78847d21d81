"""Calibration of trackers with the identified stars of recorded batches."""

from service.feature import Feature

FEATURE = Feature("calibration", __name__, ("part", "command", "serving", "routes", "pages"))
