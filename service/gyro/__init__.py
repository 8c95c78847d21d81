"""Gyros: blocks of measured rates as sent and stored, and the error model."""
