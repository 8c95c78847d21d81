"""The star image detection report, each claim compared with this project's implementation."""
