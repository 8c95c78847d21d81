"""Trends: quantities derived from batches, their measurement, and their limits."""
