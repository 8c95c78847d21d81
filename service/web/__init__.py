"""The HTTP door: routes, problems, metrics and the page."""
