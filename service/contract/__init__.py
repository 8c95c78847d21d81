"""Typed records of the service, returned by storage and encoded and described by the API."""
