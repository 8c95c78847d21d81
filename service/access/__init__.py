"""Tokens, sessions, rate limits, and the audit list."""
