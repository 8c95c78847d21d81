"""Star identification and attitude: from a batch of observed stars to a recorded attitude."""

__version__ = "0.1.0"
