"""Stars, pairs and triangles indexed by place and by separation."""
