"""Identification by weighing hypotheses: the identifier `verified`."""
