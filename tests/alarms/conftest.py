"""Databases and batches as the records' own tests have them."""

from tests.records.conftest import database, empty_database, make, opened, operations

__all__ = ["database", "empty_database", "make", "opened", "operations"]
