"""Maintenance of a database: backup, pruning, copying and verification."""
