"""Gyro blocks: their JSON, checked field by field, and the bytes that they are stored as."""
