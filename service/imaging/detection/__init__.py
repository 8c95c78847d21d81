"""From the counts of a frame to measured stars."""
