"""Missions: what is fixed for a spacecraft, read from its TOML file."""
