"""What is recorded as tables: batches with their quantities, and stars with their outcomes."""
