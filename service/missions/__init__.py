"""Missions: the fixed properties of each spacecraft, read from its TOML file."""
