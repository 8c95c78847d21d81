"""Webhooks: sending recorded events to receivers, as Standard Webhooks 1.0.0 says."""

from service.feature import Feature

FEATURE = Feature(
    "webhooks",
    __name__,
    ("tables", "part", "serving", "routes", "pages", "panels", "metrics"),
)
