"""The same inputs through two versions of the service, and every difference: see `__main__`."""
