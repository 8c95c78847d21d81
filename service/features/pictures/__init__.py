"""Pictures of any camera: attitude and lens without a mission, and cameras calibrated by them."""

from service.feature import Feature

FEATURE = Feature("pictures", __name__, ("part", "command", "routes", "pages"))
