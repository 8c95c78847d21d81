"""Simulator of Fink & Shoup 1994 for any mission: identification rates under given errors."""
