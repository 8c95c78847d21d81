"""A disk that is full or fails loses nothing that was acknowledged, and writing resumes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from service.app.factory import open_app
from service.settings import Settings
from tests.scale import size
from tests.storage import samples
from tests.storage.whole import assert_whole

FAULTS = 200
HERE = Path(__file__).parent
CHECKOUT = HERE.parents[1]


@pytest.fixture(scope="module")
def faulty_disk(tmp_path_factory):
    """The library that makes writes fail."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("there is no C compiler to build the failing disk with")
    library = tmp_path_factory.mktemp("faulty") / "faulty_disk.so"
    command = [compiler, "-shared", "-fPIC", "-O2", "-o", library, HERE / "faulty_disk.c", "-ldl"]
    subprocess.run(command, check=True)
    return library


@pytest.mark.torture
def test_whatever_write_fails_nothing_acknowledged_is_lost_and_writing_resumes(
    faulty_disk, tmp_path, sky, missions, seed, figures
):
    """Full or broken, once or for a while, at every kind of write: WAL, sync, checkpoint."""
    faults = size(FAULTS)
    folder = tmp_path / "disk"
    folder.mkdir()
    database, file = f"sqlite:///{folder / 'acquire.db'}", tmp_path / "batches.ndjson"
    sent = [
        samples.batch(
            sky, missions, f"{index}", kind=samples.KINDS[index % 4], after_s=60.0 * index
        )
        for index in range(60 + 30 * faults)
    ]
    file.write_text("\n".join(sent))
    command = [sys.executable, "-m", "tests.storage.disk_worker", database, file, str(faults)]
    environment = {"LD_PRELOAD": str(faulty_disk), "FAULTY_FOLDER": str(folder)}
    worker = subprocess.run(
        [*command, str(seed)],
        env=os.environ | environment,
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert worker.returncode == 0, worker.stderr
    told = json.loads(worker.stdout)
    assert (told["struck"], told["reads_failed"]) == (faults, 0)
    if faults == FAULTS:
        # A checkpoint that fails comes again by itself: who sends may not notice a fault.
        assert told["told_busy"] > 0
        struck = " ".join(told["kinds"])
        assert all(each in struck for each in ("acquire.db-wal", "acquire.db ", "sync"))
    app = open_app(Settings(database=database))
    try:
        assert_whole(app, told["acknowledged"])
        assert len(told["acknowledged"]) == len(sent)
        figures(
            faults=told["struck"],
            by_call_and_error=told["kinds"],
            calls_failed=told["calls_failed"],
            told_to_come_again=told["told_busy"],
            acknowledged=len(told["acknowledged"]),
        )
    finally:
        app.close()
