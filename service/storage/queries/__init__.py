"""Queries for results, trends and settings."""
