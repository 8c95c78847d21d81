"""Reading results, trends, alarms and settings."""
