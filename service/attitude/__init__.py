"""Attitude determination from matched vectors by TRIAD and QUEST, with covariance."""
