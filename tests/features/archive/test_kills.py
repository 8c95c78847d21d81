"""Killed at any moment, archiving loses no batch and doubles none."""

import hashlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from sqlalchemy import select

from service.features.archive import archiving, folder
from service.features.archive.archiving import PartFilter, restore, verify_archive
from service.storage.sql.tables import archived_batches, batches, results
from service.storage.upkeep.verify import verify
from service.times import shifted
from tests.scale import size
from tests.storage.bulk import put, result_row
from tests.storage.samples import START
from tests.waiting import wait_until

CHECKOUT = Path(__file__).parents[3]
BATCHES = 300
GIVE_UP_S = 120.0
LATER = shifted(START, 10 * 86_400.0)


def run_and_kill(database, place, output, parts, after_s):
    """Kill a worker `after_s` after so many parts; False: it had finished."""
    command = [sys.executable, "-m", "tests.features.archive.worker", database, place, LATER.text]
    with output.open("wb") as stdout:
        worker = subprocess.Popen(command, stdout=stdout, cwd=CHECKOUT)
        wait_until(
            lambda: output.read_bytes().count(b"\n") > parts or worker.poll() is not None,
            GIVE_UP_S,
            why="the worker archived nothing",
            every_s=0.002,
        )
        time.sleep(after_s)
        worker.kill()
        return worker.wait() == -signal.SIGKILL


def stored(app, table, *columns):
    with app.store.reading() as connection:
        return set(map(tuple, connection.execute(select(*(table.c[name] for name in columns)))))


@pytest.mark.slow
@pytest.mark.torture
def test_every_batch_is_there_once_after_every_kill(opened, database, tmp_path, rng, figures):
    place = tmp_path / "archive"
    place.mkdir()
    app = opened(archive_folder=place)
    drawn = [result_row(app, shifted(START, 300.0 * k)) for k in range(BATCHES)]
    for batch, _ in drawn:
        batch["fingerprint"] = hashlib.sha256(batch["input"].encode()).hexdigest()
    put(app, drawn)
    answers = stored(app, results, "id", "answer")
    ids = stored(app, batches, "id")
    killed, kills = 0, size(200)
    # A worker that has finished before it was killed shows nothing: there is another one.
    while killed < kills:
        parts, after_s = int(rng.integers(0, 10)), float(rng.uniform(0.0, 0.02))
        killed += run_and_kill(database, place, tmp_path / "out", parts, after_s)
        recorded, archived = stored(app, batches, "id"), stored(app, archived_batches, "id")
        assert recorded | archived == ids
        assert not recorded & archived
        if len(recorded) < BATCHES // 2:
            restore(app.store, place, PartFilter())
    archiving.archive(app.store, place, LATER)
    named = [part.batches for m in folder.manifests(place) for part in m.parts]
    assert sum(named) == len(stored(app, archived_batches, "id"))
    # A file that was not yet whole, or not yet named, is told of and does not count.
    harmless = ("does not name it", "was not written to its end")
    assert all(problem.endswith(harmless) for problem in verify_archive(place, {}))
    restore(app.store, place, PartFilter())
    assert stored(app, results, "id", "answer") == answers
    assert [p for p in verify(database) if "batch" not in p and "result" not in p] == []
    figures(kills=killed)
