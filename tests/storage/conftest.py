"""App on a database, and submissions to give to them."""

import pytest

from service.app.factory import open_app
from service.settings import Settings
from tests.storage import samples


@pytest.fixture
def opened(database, tmp_path):
    """Opens operations on the test's database, as often as asked; all are closed at the end."""
    held = []

    def open_operations(mission=None, **wanted):
        # Processes of their own take seconds to start: only tests about them ask for some.
        usual = {"database": database, "replay_processes": 0}
        # With PostgreSQL uploads are stored in the working folder, which all tests share.
        if not database.startswith("sqlite"):
            usual["spool"] = tmp_path / "spool"
        settings = Settings(**(usual | wanted))
        held.append(open_app(settings, mission))
        return held[-1]

    yield open_operations
    for app in held:
        app.close()


@pytest.fixture
def app(opened):
    """App on a database of their own."""
    return opened()


@pytest.fixture
def make(sky, missions):
    """Makes submissions: make("b1", kind="suspect", run="r", after_s=60)."""

    def submission(name="b1", **wanted):
        return samples.submission(sky, missions, name, **wanted)

    return submission
