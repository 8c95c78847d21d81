"""What the service sends by itself."""
