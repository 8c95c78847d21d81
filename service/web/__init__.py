"""HTTP layer of the service: the API, the console, and the server."""
