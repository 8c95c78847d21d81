"""The memory that is left, as the kernel tells it, and replays that it is not enough for."""

import pytest

from service.errors import Busy
from service.ingest import memory
from tests.fresh_databases import sqlite_at
from tests.storage import samples
from tests.web.serving import serving_in_process

MIB = 1 << 20


@pytest.fixture
def kernel(tmp_path):
    """Files as Linux has them: `kernel(path, text)` writes one; `kernel.free()` reads them."""

    def write(path, text):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)

    write.free = lambda: memory.free_bytes(tmp_path / "proc", tmp_path / "cgroup")
    write("proc/meminfo", "MemTotal: 16000000 kB\nMemAvailable: 4194304 kB\n")
    return write


def group(kernel, folder, limit, current, inactive):
    kernel(f"cgroup/{folder}/memory.max", f"{limit}\n")
    kernel(f"cgroup/{folder}/memory.current", f"{current}\n")
    kernel(f"cgroup/{folder}/memory.stat", f"anon 1\ninactive_file {inactive}\n")


def test_without_groups_it_is_that_of_the_machine(kernel):
    assert kernel.free() == 4096 * MIB
    kernel("proc/self/cgroup", "0::/\n")
    assert kernel.free() == 4096 * MIB


def test_the_tightest_of_nested_groups_counts(kernel):
    kernel("proc/self/cgroup", "0::/system.slice/acquire.service\n")
    group(kernel, "system.slice", 1024 * MIB, 900 * MIB, 100 * MIB)
    group(kernel, "system.slice/acquire.service", "max", 400 * MIB, 0)
    assert kernel.free() == 224 * MIB
    group(kernel, "system.slice/acquire.service", 600 * MIB, 500 * MIB, 50 * MIB)
    assert kernel.free() == 150 * MIB
    group(kernel, "system.slice/acquire.service", 600 * MIB, 700 * MIB, 0)
    assert kernel.free() == 0


def test_within_a_container_the_group_is_at_the_root(kernel):
    kernel("proc/self/cgroup", "0::/docker/0123\n")
    group(kernel, "", 600 * MIB, 300 * MIB, 20 * MIB)
    assert kernel.free() == 320 * MIB


def test_groups_of_the_first_version_are_read(kernel):
    kernel("proc/self/cgroup", "5:cpu,cpuacct:/x\n4:memory:/x\n0::/\n")
    kernel("cgroup/memory/x/memory.limit_in_bytes", f"{600 * MIB}\n")
    kernel("cgroup/memory/x/memory.usage_in_bytes", f"{450 * MIB}\n")
    kernel("cgroup/memory/x/memory.stat", f"total_inactive_file {10 * MIB}\n")
    kernel("cgroup/memory/memory.limit_in_bytes", "9223372036854771712\n")
    assert kernel.free() == 160 * MIB


def test_a_system_that_tells_nothing_admits(tmp_path, monkeypatch):
    assert memory.free_bytes(tmp_path, tmp_path) is None
    monkeypatch.setattr(memory, "free_bytes", lambda: None)
    memory.require_memory_for_replay(64)


def test_a_replay_that_does_not_fit_is_refused_until_there_is_room(
    tmp_path, monkeypatch, sky, missions
):
    free = 90 * MIB
    monkeypatch.setattr(memory, "free_bytes", lambda: free)
    with pytest.raises(Busy, match="a replay needs 656 MB of memory and 90 MB are left"):
        memory.require_memory_for_replay(2)
    with serving_in_process(sqlite_at(tmp_path / "acquire.db")) as service:
        upload = {"url": "/api/v1/replays", "params": {"run": "r"}}
        upload |= {"content": samples.batch(sky, missions, "b1") + "\n"}
        upload |= {"headers": {"Content-Type": "application/x-ndjson"}}
        refused = service.client.post(**upload)
        assert refused.status_code == 503
        assert int(refused.headers["Retry-After"]) == memory.RETRY_S
        assert "90 MB are left" in refused.json()["detail"]
        # Single batches need no more than they had.
        posted = service.client.post(
            "/api/v1/batches",
            content=samples.batch(sky, missions, "b2"),
            headers={"Content-Type": "application/json"},
        )
        assert posted.status_code == 201
        free = 4096 * MIB
        assert service.client.post(**upload).status_code == 202
