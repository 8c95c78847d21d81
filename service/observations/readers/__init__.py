"""Telemetry files and request bodies as lines, each one batch."""
