"""Telemetry from a message bus: follows a stream of NATS JetStream."""
