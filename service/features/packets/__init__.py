"""Input format for CCSDS space packets, converted to batches and gyro blocks."""

from service.feature import Feature

FEATURE = Feature("packets", __name__, ("formats", "telemetry"))
