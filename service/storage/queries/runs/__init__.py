"""Two runs of one spacecraft side by side: batch by batch, and the rates of each over time."""
