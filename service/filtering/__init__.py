"""Attitude over time: a filter of attitude and gyro bias, and its smoother."""
