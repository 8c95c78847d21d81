"""Features, one folder each; see `service.feature`."""
