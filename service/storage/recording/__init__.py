"""Writing results with their stars, and the events that tell of them."""
