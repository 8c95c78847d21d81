"""Advice on a mission's settings from recorded batches."""
