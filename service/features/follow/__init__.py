"""Telemetry from a message bus: follows a stream of NATS JetStream."""

from service.feature import Feature

FEATURE = Feature("follow", __name__, ("command", "serving"))
