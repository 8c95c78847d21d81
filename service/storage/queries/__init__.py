"""Reading results, trends and settings."""
