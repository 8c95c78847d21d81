"""The processes that compile kernels: side by side, there while the build runs, and no longer."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time

import numba
import pytest

from service.acquire.kernel_build import KernelBuild
from service.errors import Stopping


@pytest.fixture
def nothing_compiled(monkeypatch, tmp_path):
    """An empty cache, for this process and its children."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))


@pytest.fixture
def building(missions, nothing_compiled):
    """A build in a thread; the processes that it started, once there are so many."""
    others = multiprocessing.active_children()
    build, stopped = KernelBuild(), []

    def run():
        try:
            build.run(missions)
        except Stopping as error:
            stopped.append(error)

    thread = threading.Thread(target=run)

    def started(count):
        thread.start()
        for _ in range(300):
            children = [each for each in multiprocessing.active_children() if each not in others]
            if len(children) >= count:
                return children
            time.sleep(0.01)
        raise AssertionError(f"{children} were started")

    yield started, build
    build.cancel()
    thread.join()
    assert len(stopped) == 1


def test_two_compile_side_by_side_and_end_when_it_is_cancelled(building, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    started, build = building
    children = started(2)
    assert len(children) == 2
    build.cancel()
    for child in children:
        # The build's own thread may be the one that hears of the end first.
        deadline = time.monotonic() + 10
        while child.exitcode is None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert child.exitcode == -signal.SIGKILL
    assert build.is_needed


def test_without_a_second_processor_one_compiles_all(building, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    started, _ = building
    assert len(started(1)) == 1


def test_they_end_with_a_parent_that_is_killed(nothing_compiled):
    code = (
        "import multiprocessing, threading, time\n"
        "from service.acquire.kernel_build import KernelBuild\n"
        "if __name__ == '__main__':\n"
        "    threading.Thread(target=KernelBuild().run, args=({},), daemon=True).start()\n"
        "    while not (children := multiprocessing.active_children()):\n"
        "        time.sleep(0.01)\n"
        "    print(children[0].pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        parent.send_signal(signal.SIGKILL)
    for _ in range(300):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise AssertionError(f"the process {pid} is still there")
