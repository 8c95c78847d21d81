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

KILLS = {"sqlite": 500, "postgresql": 100}
BATCHES_A_ROUND = 150
CHECKOUT = Path(__file__).parents[2]


def run_and_kill(database, file, output, after_s):
    """Kill a worker `after_s` after its first acknowledgement; False: it had finished."""
    with output.open("wb") as stdout:
        command = [sys.executable, "-m", "tests.storage.worker", database, str(file)]
        worker = subprocess.Popen(command, stdout=stdout, stderr=subprocess.DEVNULL, cwd=CHECKOUT)
        give_up = time.monotonic() + 60
        while not output.stat().st_size and worker.poll() is None and time.monotonic() < give_up:
            time.sleep(0.005)
        time.sleep(after_s)
        worker.kill()
        return worker.wait() == -signal.SIGKILL


def acknowledged_in(output):
    # A line that the kill cut short was not heard by anybody.
    return [
        line.split() for line in output.read_text().splitlines(keepends=True) if line[-1:] == "\n"
    ]


@pytest.mark.torture
def test_nothing_acknowledged_is_lost_torn_or_doubled_by_kills(
    database, tmp_path, sky, missions, rng, figures
):
    """Each round repeats the batches of the one before, as clients do that were left waiting."""
    acknowledged, killed = {}, 0
    kills = size(KILLS[database.partition(":")[0].partition("+")[0]])
    lines = []
    for round_number in range(kills):
        fresh = [
            samples.batch(
                sky,
                missions,
                f"{round_number}-{index}",
                kind=samples.KINDS[index % len(samples.KINDS)],
                after_s=60.0 * index,
            )
            for index in range(BATCHES_A_ROUND)
        ]
        file, output = tmp_path / "batches.ndjson", tmp_path / "acknowledged"
        file.write_text("\n".join(lines[-BATCHES_A_ROUND:] + fresh))
        lines += fresh
        killed += run_and_kill(database, file, output, after_s=float(rng.uniform(0, 0.4)))
        for id, digest in acknowledged_in(output):
            assert acknowledged.setdefault(id, digest) == digest
        app = open_app(Settings(database=database))
        try:
            assert_whole(app, acknowledged)
        finally:
            app.close()
    figures(kills=kills, while_at_work=killed, acknowledged=len(acknowledged), sent=len(lines))
    assert acknowledged
    # Had the workers finished, nothing would have been shown.
    assert killed > kills / 2
