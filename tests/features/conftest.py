"""Fixtures that the tests of several features use."""

from tests.web.conftest import address, app, batch, client, drawn, full_run, post, run

__all__ = ["address", "app", "batch", "client", "drawn", "full_run", "post", "run"]
