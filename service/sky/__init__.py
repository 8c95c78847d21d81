"""WHAT IS THERE: the catalog, run catalogs, zones, pairs, the Sun and the caches."""
