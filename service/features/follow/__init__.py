"""Telemetry from a message bus: submits messages of a NATS JetStream stream."""

from service.feature import Feature

FEATURE = Feature("follow", __name__, ("command", "serving"))
