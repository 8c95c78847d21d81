"""The app, split by subject: the functions behind web, commands, replay and demonstration."""
