"""SQLite's file moved away, replaced or deleted while it is served: told of, and nothing is lost.

And no command that only reads makes a file.
"""

import shutil

import httpx
import pytest
from sqlalchemy import select

from service.app.factory import open_app
from service.storage.sql.tables import batches
from service.storage.upkeep.verify import verify
from tests.storage import samples
from tests.web.serving import in_process_settings, serving_in_process
from tests.web.test_hanging_database import ready_again

PARTS = ("", "-wal", "-shm")


@pytest.fixture
def file(tmp_path):
    folder = tmp_path / "records"
    folder.mkdir()
    return folder / "acquire.db"


@pytest.fixture
def post(sky, missions):
    def send(url, name):
        body = samples.batch(sky, missions, name)
        headers = {"Content-Type": "application/json"}
        return httpx.post(f"{url}/api/v1/batches", content=body, headers=headers, timeout=30)

    return send


def moved(file, folder, parts=PARTS):
    folder.mkdir(exist_ok=True)
    for part in parts:
        place = file.with_name(file.name + part)
        if place.exists():
            place.rename(folder / place.name)


def assert_told(url, answer):
    """Posts, pages and the probe say it; none of them with a word of where the file is."""
    for each in (answer, httpx.get(f"{url}/api/v1/batches"), httpx.get(f"{url}/readyz")):
        assert (each.status_code, "Retry-After" in each.headers) == (503, True)
        assert "acquire.db" not in each.text
    assert "moved, replaced or deleted" in answer.json()["detail"]


def names_in(file):
    app = open_app(in_process_settings(f"sqlite:///{file}"), create=False)
    try:
        with app.context.reading() as connection:
            return set(connection.scalars(select(batches.c.batch)))
    finally:
        app.close()


@pytest.mark.parametrize(
    "parts", [PARTS, pytest.param(("",), marks=pytest.mark.slow)], ids=["with its log", "alone"]
)
def test_moved_away_nothing_is_acknowledged_and_moved_back_all_is_there(
    file, tmp_path, post, parts
):
    away = tmp_path / "away"
    with serving_in_process(f"sqlite:///{file}") as service:
        url = service.url
        assert post(url, "before").status_code == 201
        moved(file, away, parts)
        for k in range(5):
            assert_told(url, post(url, f"meanwhile-{k}"))
        assert not file.exists()
        moved(away / file.name, file.parent, parts)
        assert post(url, "after").status_code == 201
        ready_again(url)
    assert names_in(file) == {"before", "after"}
    assert verify(f"sqlite:///{file}") == []


def test_replaced_by_another_file_neither_is_written_to(file, tmp_path, post):
    with serving_in_process(f"sqlite:///{file}") as service:
        assert post(service.url, "before").status_code == 201
    copy = tmp_path / "copy.db"
    shutil.copy(file, copy)
    with serving_in_process(f"sqlite:///{file}") as service:
        url = service.url
        assert post(url, "between").status_code == 201
        moved(file, tmp_path / "away")
        copy.rename(file)
        assert_told(url, post(url, "meanwhile"))
    assert names_in(file) == {"before"}
    assert names_in(tmp_path / "away" / file.name) == {"before", "between"}


def test_deleted_nothing_is_acknowledged_and_no_file_is_made(file, post):
    with serving_in_process(f"sqlite:///{file}") as service:
        url = service.url
        assert post(url, "before").status_code == 201
        for part in PARTS:
            file.with_name(file.name + part).unlink(missing_ok=True)
        for k in range(5):
            assert_told(url, post(url, f"meanwhile-{k}"))
        assert not file.exists()
    assert not file.exists()


@pytest.mark.parametrize(
    "command",
    [
        ("database", "check"),
        ("database", "verify"),
        ("database", "backup", "copy.db"),
        ("database", "prune", "--before", "2000-01-01T00:00:00Z"),
        ("token", "list"),
        ("token", "revoke", "nobody"),
    ],
    ids=lambda command: " ".join(command[:2]),
)
def test_a_command_about_what_is_there_makes_no_file(acquire, tmp_path, command):
    code, _, complaint = acquire(*command, "--database", f"sqlite:///{tmp_path}/none.db")
    assert code != 0
    assert "there is no such file" in complaint
    assert list(tmp_path.iterdir()) == []
