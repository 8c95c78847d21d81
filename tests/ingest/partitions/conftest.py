"""A database with an archive, and some days of batches that are archived in small parts."""

import json

import pytest

from service.observations.schema import submission_from_json
from service.simulate.stretches import Pass, Trouble, Troubles
from service.simulate.telemetry import draw_pass
from service.storage.archive import archiving
from service.times import parse_utc, shifted
from tests.ingest.partitions.checks import BATCHES, CADENCE_S, PART, START
from tests.storage.conftest import app, make, opened

__all__ = ["app", "make", "opened"]


@pytest.fixture(scope="session")
def bodies(missions, sky):
    """A pass of XTE and a shorter one of SWAS, as they are sent."""
    troubles = Troubles(Trouble(), Trouble(), Trouble(), Trouble(1.0, 12.0))

    def drawn(spacecraft, count, seed):
        wanted = Pass(count, seed, START, CADENCE_S, stars=4, troubles=troubles)
        return [json.dumps(each.batch) for each in draw_pass(missions[spacecraft], sky, wanted)]

    return [*drawn("XTE", BATCHES, 1), *drawn("SWAS", 12, 2)]


@pytest.fixture
def place(tmp_path):
    (tmp_path / "archive").mkdir()
    return tmp_path / "archive"


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch):
    monkeypatch.setattr(archiving, "MOST_BATCHES", PART)
    monkeypatch.setattr("service.ingest.partitions.plan.MOST_BATCHES", PART)


@pytest.fixture
def archived(opened, place, bodies):
    """An app whose first day is archived and whose second is recorded."""
    app = opened(archive_folder=place)
    made = [submission_from_json(body) for body in bodies]
    assert all(not isinstance(each, Exception) for each in app.submissions.submit_many(made))
    archiving.archive(app.store, place, shifted(parse_utc(START), 86_400.0))
    return app
