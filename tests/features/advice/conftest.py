"""Fixtures of tests over a database of their own."""

from tests.storage.conftest import app, make, opened

__all__ = ["app", "make", "opened"]
