"""Check of the star image detection report: each claim compared with this project's results."""
