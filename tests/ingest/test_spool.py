"""Uploads outlast the process that took them: a restart goes on where it was."""

import os
import signal
import time
from itertools import count

import httpx
import pytest
from msgspec.structs import asdict
from sqlalchemy import func, select

from service.access import Caller
from service.app import replays as app_replays
from service.errors import Busy, Forbidden
from service.ingest.spool import UNLOCKED_S, Spool
from service.storage.sql.tables import batches
from tests.ingest.test_replays import finished
from tests.waiting import wait_until
from tests.web.serving import served

LINES = 3000
LONGEST = 1 << 20


@pytest.fixture
def lines(make):
    text = make().text
    return [text.replace('"b1"', f'"n{k}"', 1).encode() + b"\n" for k in range(LINES)]


def upload(app, lines, caller=Caller("local", frozenset()), run="pass", **options):  # noqa: B008
    file = app.replays.new_upload(caller)
    file.writelines(lines)
    form = app_replays.UploadForm("identity", LONGEST)
    return app.replays.start_upload(file, form, run, caller, **options)


def recorded(app, run):
    with app.store.reading() as connection:
        counts = select(func.count(), func.count(batches.c.batch.distinct()))
        return tuple(connection.execute(counts.where(batches.c.run == run)).one())


def stored(app):
    folder = app.settings.spool_folder
    return sorted(each.name for each in folder.iterdir()) if folder.is_dir() else []


def test_an_upload_is_removed_when_its_replay_is_over(opened, lines):
    app = opened(replay_processes=0)
    id = upload(app, lines[:20])
    assert stored(app)
    assert finished(app, id).state == "done"
    wait_until(lambda: stored(app) == [], why="the upload is still there")


def interrupted(opened, lines):
    """An app that finds a replay which was closed in the middle; with its id and run."""
    for attempt in count():
        app, run = opened(replay_processes=0), f"pass-{attempt}"
        id = upload(app, lines, run=run, total=len(lines))
        wait_until(lambda app=app, id=id: app.replays.get(id).lines.done >= 64, every_s=0.002)
        app.close()
        later = opened(replay_processes=0)
        # On a busy machine it may be over before it is stopped.
        if later.replays.get(id).state != "done":
            return later, id, run
        later.close()


def test_a_replay_goes_on_after_a_restart_where_it_was(opened, lines):
    later, id, run = interrupted(opened, [b'{"cut\n', *lines[:400]])
    before = later.replays.get(id)
    # It will be continued: it has not ended.
    assert (before.state, before.finished) == ("waiting", None)
    assert 64 <= before.lines.done < 401
    later.replays.resume()
    after = finished(later, id)
    assert (after.state, asdict(after.lines)) == ("done", {"total": 401, "done": 401, "refused": 1})
    assert after.counts.new + after.counts.repeated == 400
    assert recorded(later, run) == (400, 400)
    assert [each.line for each in after.errors] == [1]


def test_one_that_waits_can_be_cancelled_and_one_without_its_file_ends(opened, lines):
    app = opened(replay_processes=0)
    ids = [upload(app, some) for some in (lines, lines[:300], lines[:300])]
    app.close()
    for place in app.settings.spool_folder.glob(f"{ids[0]}*"):
        place.unlink()
    later = opened(replay_processes=0)
    states = [later.replays.get(id).state for id in ids]
    assert states == ["interrupted", "waiting", "waiting"]
    assert later.replays.cancel(ids[1]).state == "cancelled"
    later.replays.resume()
    assert finished(later, ids[2]).state == "done"
    assert later.replays.get(ids[1]).state == "cancelled"


def test_what_a_token_is_bound_to_holds_after_a_restart(opened, lines):
    app = opened(replay_processes=0)
    bound = Caller("pipeline", frozenset(["submit"]), frozenset(["SWAS"]), "T1")
    id = upload(app, lines[:300], bound)
    app.close()
    later = opened(replay_processes=0)
    later.replays.resume()
    state = finished(later, id)
    assert state.lines.refused == 300
    assert str(Forbidden("pipeline is bound to SWAS, not to XTE")) in str(state.errors[-1])


def test_one_token_takes_no_more_than_its_slots(opened, lines, monkeypatch):
    monkeypatch.setattr(app_replays, "MAX_OF_ONE_TOKEN", 1)
    app = opened(replay_processes=0)
    one, other = (Caller(name, frozenset(), None, name) for name in ("T1", "T2"))
    first = upload(app, lines, one)
    with pytest.raises(Busy, match="of this token"):
        app.replays.new_upload(one)
    upload(app, lines[:10], other)
    app.replays.cancel(first)
    finished(app, first)
    app.replays.new_upload(one).close()


@pytest.mark.slow
def test_a_killed_service_goes_on_with_an_upload_when_it_is_started_again(tmp_path, lines):
    database = f"sqlite:///{tmp_path / 'acquire.db'}"
    head = {"Content-Type": "application/x-ndjson"}
    with served(database) as (process, url):
        path = f"{url}/api/v1/replays?run=pass"
        answer = httpx.post(path, content=b"".join(lines), headers=head, timeout=60)
        assert answer.status_code == 202
        place = answer.headers["Location"]
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    with served(database) as (_, url):
        wait_until(
            lambda: httpx.get(url + place).json()["state"] != "running",
            seconds=120,
            why="the replay does not end",
            every_s=0.1,
        )
        state = httpx.get(url + place).json()
    assert (state["state"], state["lines"]["done"]) == ("done", LINES)
    assert state["counts"]["new"] + state["counts"]["repeated"] == LINES


def aged(path):
    old = time.time() - UNLOCKED_S - 1.0
    os.utime(path, (old, old))
    return path


def test_an_upload_that_was_broken_off_is_removed_by_the_next_one(tmp_path):
    """A process that was killed leaves its file, whose lock has ended with it."""
    left = tmp_path / "killed.part"
    left.write_bytes(b"{")
    aged(left)
    young = tmp_path / "young.part"
    young.write_bytes(b"{")
    spool = Spool(tmp_path)
    receiving = spool.new_file()
    aged(receiving.name)
    with spool.new_file() as another:
        parts = {each.name for each in tmp_path.glob("*.part")}
        names = {os.path.basename(each.name) for each in (receiving, another)}
        assert parts == names | {"young.part"}
    receiving.close()
    assert list(spool.left()) == []
    assert not os.path.exists(receiving.name)
