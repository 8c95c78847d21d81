"""HTTP API: one module for the routes of each subject."""
