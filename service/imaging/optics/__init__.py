"""Images of a point source through an aperture."""
