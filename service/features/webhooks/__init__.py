"""Webhooks: recorded events sent to receivers, following Standard Webhooks 1.0.0."""

from service.feature import Feature

FEATURE = Feature(
    "webhooks",
    __name__,
    ("tables", "part", "serving", "routes", "pages", "metrics"),
)
