"""Alarms: limits on monitored quantities, and the operators' responses to violations."""

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
        "metrics",
    ),
)
