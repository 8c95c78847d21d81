"""Star identification by planar triangles: the identifier `ptp`."""
