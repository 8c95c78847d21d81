"""Package of features, optional subjects of the service, one folder each; see `service.feature`."""
