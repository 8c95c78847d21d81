"""Image processing for star cameras: images of point sources, centroids, frames."""
