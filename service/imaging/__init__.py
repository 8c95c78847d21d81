"""How light becomes a star: images of a point source, and where on the sensor the star stands."""
