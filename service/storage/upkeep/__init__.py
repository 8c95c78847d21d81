"""Backup, pruning and verification of a database."""
