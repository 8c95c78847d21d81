"""Grades of attitude: what the filter and the smoother make of recorded batches and rates."""
