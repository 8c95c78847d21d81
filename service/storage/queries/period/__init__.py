"""The batches of a period: a bounded sample of them, and the arrays that its charts show."""
