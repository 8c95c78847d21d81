"""Detection of stars: from the counts of a frame to candidates and measured stars."""
