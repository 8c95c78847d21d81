"""Maintenance of a database: backup, archiving, pruning, copying and verification."""
