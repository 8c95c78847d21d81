"""WHAT WE KEEP: batches with their inputs, results, solutions and trends, in SQL."""
