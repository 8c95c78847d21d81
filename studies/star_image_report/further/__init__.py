"""What the report names and does not work out: each worked out, and held against another way."""
