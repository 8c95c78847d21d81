"""Alarms: limits held against quantities, and what operators do about values out of them."""

from service.feature import Feature

FEATURE = Feature(
    "alarms",
    __name__,
    (
        "tables",
        "projection",
        "state",
        "shares",
        "part",
        "serving",
        "routes",
        "pages",
        "panels",
        "metrics",
    ),
)
