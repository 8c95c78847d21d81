"""The star catalog, the run catalogs made from it, and how catalog files are read."""
