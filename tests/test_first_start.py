"""A first start: several processes on an empty folder of kernels and files of the sky."""

import json
import pickle
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from service.compiled.checked_file import content_of
from tests.fresh_databases import sqlite_at
from tests.storage import samples
from tests.waiting import wait_until
from tests.web.serving import is_ready, serving

WORKER = """
import json, sys
from service.acquire import acquire
from service.acquire.prewarm import prewarm_kernels
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

sky, missions = SkyModel(load_embedded(), LruCache(64 << 20)), load_missions()
prewarm_kernels(sky, missions)
batch = submission_from_json(sys.stdin.read()).batch
print(json.dumps(acquire(batch, missions[batch.spacecraft], sky).solution.quaternion.tolist()))
"""
SECONDS = 1_800.0


@pytest.mark.slow
def test_two_servers_four_workers_and_a_command_on_an_empty_folder_share_one_build(
    tmp_path, monkeypatch, sky, missions
):
    folder = tmp_path / "kernels"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    batch = samples.batch(sky, missions, "first")
    (tmp_path / "first.ndjson").write_text(batch + "\n")
    command = [sys.executable, "-m", "service.cli", "replay", "--in-process"]
    command += [str(tmp_path / "first.ndjson"), "--results", str(tmp_path / "results.ndjson")]
    command += ["--database", sqlite_at(tmp_path / "replay.db")]
    with ExitStack() as stack:
        logs = [stack.enter_context((tmp_path / f"{place}.log").open("wb")) for place in range(2)]
        servers = [
            stack.enter_context(serving(sqlite_at(tmp_path / f"{place}.db"), log))
            for place, log in enumerate(logs)
        ]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        workers = [subprocess.Popen([sys.executable, "-c", WORKER], **pipes) for _ in range(4)]
        replay = subprocess.run(command, capture_output=True, timeout=SECONDS, check=False)
        assert replay.returncode == 0, replay.stderr.decode()
        found = [json.loads((tmp_path / "results.ndjson").read_text())["attitude"]["quaternion"]]
        for worker in workers:
            printed, errors = worker.communicate(batch.encode(), timeout=SECONDS)
            assert worker.returncode == 0, errors.decode()
            found.append(json.loads(printed))
        for process, url in servers:
            wait_until(lambda p=process, u=url: is_ready(p, u), SECONDS, every_s=0.5)
            answer = httpx.post(f"{url}/api/v1/batches", json=json.loads(batch), timeout=60)
            assert answer.status_code == 201, answer.text
            found.append(answer.json()["attitude"]["quaternion"])
    for place in range(2):
        assert "Traceback" not in (tmp_path / f"{place}.log").read_text()
    assert found == [pytest.approx(samples.QUATERNION, abs=1e-4)] * 7
    assert found == [pytest.approx(found[0], abs=1e-9)] * 7
    signatures = {}
    for path in folder.rglob("*.nbi"):
        _, _, overloads = pickle.loads(content_of(Path(path)))
        signatures[path.stem] = len(overloads)
    assert set(signatures.values()) == {1}
