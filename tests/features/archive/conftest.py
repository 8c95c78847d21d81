"""App on a database of its own, as the records' own tests have it."""

from tests.storage.conftest import app, make, opened

__all__ = ["app", "make", "opened"]
