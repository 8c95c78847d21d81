"""WHO FLIES: what is fixed for a mission, read from its TOML file."""
