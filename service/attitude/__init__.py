"""Attitude determination: TRIAD and QUEST from matched vectors, with covariance."""
