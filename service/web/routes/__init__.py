"""The routes by resource; together they are `/api/v1` and the three probes beside it."""
