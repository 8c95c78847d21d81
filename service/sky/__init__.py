"""The sky: star catalog, run catalogs, zones, pairs of stars, the Sun, and their cache."""
