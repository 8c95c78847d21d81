"""The typed records of the service: what storage returns, the API encodes, OpenAPI describes."""
