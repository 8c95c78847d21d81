"""HTTP: the API, the console, and the server."""
