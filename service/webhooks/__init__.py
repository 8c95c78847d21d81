"""Webhooks: sending recorded events to receivers, as Standard Webhooks 1.0.0 says."""
