"""Simulator of Fink & Shoup 1994, and comparison with the paper's tables."""
