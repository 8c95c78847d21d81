"""Queries over recorded and archived batches together."""
