"""Gyro blocks in the records."""
