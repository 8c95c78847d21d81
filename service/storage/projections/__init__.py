"""Projections: data derived from recorded batches and results after the answer is sent."""
