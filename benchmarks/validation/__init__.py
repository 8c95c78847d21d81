"""Benchmarks of correct answers: docs/verification.md and further pages."""
