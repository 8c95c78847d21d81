"""Fixtures that the tests of several features use."""

from tests.web.conftest import address, app, client, drawn, full_run, run

__all__ = ["address", "app", "client", "drawn", "full_run", "run"]
