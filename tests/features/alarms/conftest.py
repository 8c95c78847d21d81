"""Databases and batches as the records' own tests have them."""

from tests.storage.conftest import app, make, opened

__all__ = ["app", "make", "opened"]
