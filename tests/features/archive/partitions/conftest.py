"""A database with an archive, and some days of batches that are archived in small parts."""

import json
import shutil

import pytest
from sqlalchemy import make_url

from service.app.factory import open_app
from service.features.archive import archiving
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.simulate.stretches import Pass, Trouble, Troubles
from service.simulate.telemetry import draw_pass
from service.times import parse_utc, shifted
from tests.features.archive.partitions.checks import BATCHES, CADENCE_S, PART, START
from tests.fresh_databases import sqlite_at


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
    monkeypatch.setattr("service.features.archive.partition_coordinator.MOST_BATCHES", PART)


def fill(app, place, bodies):
    """Record all batches, and archive the first day."""
    made = [submission_from_json(body) for body in bodies]
    assert all(not isinstance(each, Exception) for each in app.submissions.submit_many(made))
    archiving.archive(app.store, place, shifted(parse_utc(START), 86_400.0))
    return app


@pytest.fixture(scope="session")
def archived_files(bodies, tmp_path_factory):
    """A folder with an archive and its database on SQLite, to be copied."""
    folder = tmp_path_factory.mktemp("archived")
    (folder / "archive").mkdir()
    settings = Settings(database=sqlite_at(folder / "acquire.db"), replay_processes=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archiving, "MOST_BATCHES", PART)
        fill(open_app(settings), folder / "archive", bodies).close()
    return folder


@pytest.fixture
def archived(opened, place, bodies, database, request):
    """An app whose first day is archived and whose second is recorded."""
    if not database.startswith("sqlite"):
        return fill(opened(archive_folder=place), place, bodies)
    files = request.getfixturevalue("archived_files")
    shutil.copytree(files / "archive", place, dirs_exist_ok=True)
    shutil.copy(files / "acquire.db", make_url(database).database)
    return opened(archive_folder=place)
