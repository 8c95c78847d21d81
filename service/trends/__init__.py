"""Trends: the quantities that follow from batches, how they are measured, and their limits."""
