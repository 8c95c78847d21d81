"""The star catalog, the run catalogs made from it, and readers of catalog files."""
