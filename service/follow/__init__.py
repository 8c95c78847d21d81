"""Telemetry from a message bus: each message is recorded once, however often it is delivered."""
