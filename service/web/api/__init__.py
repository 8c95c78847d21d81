"""The HTTP API: routes, schemas, parameters."""
