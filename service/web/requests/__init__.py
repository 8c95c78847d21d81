"""Shared by the handlers of API and console: access, bodies, parameters, responses, problems."""
