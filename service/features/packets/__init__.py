"""CCSDS space packets as batches and gyro blocks."""

from service.feature import Feature

FEATURE = Feature("packets", __name__, ("formats", "telemetry"))
