"""Webhooks in the records: what is registered, what waits, and who delivers."""
