"""Fixtures that the tests of several features use."""

from tests.web.conftest import address, app, client, full_run

__all__ = ["address", "app", "client", "full_run"]
