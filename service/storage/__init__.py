"""Storage of the service in SQL: batches, results, and all that follows from them."""
