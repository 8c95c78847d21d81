"""Databases and batches as the records' own tests have them."""

from tests.records.conftest import make, opened, operations

__all__ = ["make", "opened", "operations"]
