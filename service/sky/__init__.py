"""The sky model: star catalog, run catalogs, zones, star pairs, the Sun, and a cache for them."""
