"""WHAT TO CHANGE: what stored batches say of a mission's settings."""
