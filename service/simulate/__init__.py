"""Simulation of telemetry and frames with known truth, drawn from the real sky."""
