"""Identification by planar triangles: the identifier `ptp`."""
