"""Projections: what follows from the record of batches and results, made after the answer."""
