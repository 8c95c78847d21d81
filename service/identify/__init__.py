"""Identification: which catalog star each observed star is."""
