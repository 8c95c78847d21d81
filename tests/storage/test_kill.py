"""Whatever was acknowledged is stored, at whatever moment the process is killed."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.app.factory import open_app
from service.settings import Settings
from tests.scale import size
from tests.storage import samples
from tests.storage.whole import assert_whole
from tests.waiting import wait_until

GIVE_UP_S = 120.0

KILLS = {"sqlite": 500, "postgresql": 100}
BATCHES_A_ROUND = 60
CHECKOUT = Path(__file__).parents[2]


def run_and_kill(database, file, output, acknowledged, after_s):
    """Kill a worker `after_s` after so many acknowledgements; False: it had finished."""
    with output.open("wb") as stdout:
        command = [sys.executable, "-m", "tests.storage.worker", database, str(file)]
        worker = subprocess.Popen(command, stdout=stdout, stderr=subprocess.DEVNULL, cwd=CHECKOUT)
        wait_until(
            lambda: output.read_bytes().count(b"\n") >= acknowledged or worker.poll() is not None,
            GIVE_UP_S,
            why="the worker acknowledged nothing",
            every_s=0.002,
        )
        time.sleep(after_s)
        worker.kill()
        return worker.wait() == -signal.SIGKILL


def acknowledged_in(output):
    # A line that the kill cut short was not heard by anybody.
    return [
        line.split() for line in output.read_text().splitlines(keepends=True) if line[-1:] == "\n"
    ]


@pytest.mark.both_databases
@pytest.mark.torture
@pytest.mark.slow("postgresql")
def test_nothing_acknowledged_is_lost_torn_or_doubled_by_kills(
    database, tmp_path, sky, missions, rng, figures
):
    """Each round repeats the batches of the one before, as clients do that were left waiting.

    A worker that has finished before it was killed shows nothing: there is another round.
    """
    acknowledged, killed, rounds = {}, 0, 0
    kills = size(KILLS[database.partition(":")[0].partition("+")[0]])
    lines = []
    while killed < kills:
        fresh = [
            samples.batch(
                sky,
                missions,
                f"{rounds}-{index}",
                kind=samples.KINDS[index % len(samples.KINDS)],
                after_s=60.0 * index,
            )
            for index in range(BATCHES_A_ROUND)
        ]
        file, output = tmp_path / "batches.ndjson", tmp_path / "acknowledged"
        file.write_text("\n".join(lines[-BATCHES_A_ROUND:] + fresh))
        lines += fresh
        after = int(rng.integers(1, BATCHES_A_ROUND // 2))
        killed += run_and_kill(database, file, output, after, float(rng.uniform(0, 0.02)))
        rounds += 1
        for id, digest in acknowledged_in(output):
            assert acknowledged.setdefault(id, digest) == digest
        app = open_app(Settings(database=database))
        try:
            assert_whole(app, acknowledged)
        finally:
            app.close()
    figures(kills=killed, rounds=rounds, acknowledged=len(acknowledged), sent=len(lines))
    assert acknowledged
