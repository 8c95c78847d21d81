"""The lost-in-space solver: stars and attitude identified without any prior knowledge."""
