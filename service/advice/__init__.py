"""The size of zones, checks of mission files, and intervals of estimates."""
