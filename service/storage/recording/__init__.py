"""Writing results with their stars, trends, events and alarms."""
