"""Shared parts of API and console handlers: access, bodies, parameters, responses, problems."""
