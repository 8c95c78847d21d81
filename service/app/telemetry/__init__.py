"""Measurements that are recorded beside batches."""
