"""The app: what every entrance (web, command, replay, demo) uses, split by subject."""
