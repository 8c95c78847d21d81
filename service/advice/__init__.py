"""Advice on missions: zone sizes, checks of mission files, intervals of estimates."""
