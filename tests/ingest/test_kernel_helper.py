"""The process that compiles beside the first build: there while the build runs, and no longer."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

from service.ingest.kernel_helper import compiling_beside


def started_since(others):
    """Processes started since `others` was taken: pools of other tests may have theirs still."""
    return [child for child in multiprocessing.active_children() if child not in others]


def test_it_runs_while_the_build_does_and_ends_with_it(missions):
    others = multiprocessing.active_children()
    with compiling_beside(missions):
        (helper,) = started_since(others)
        assert helper.is_alive()
    assert not helper.is_alive()
    assert started_since(others) == []


def test_without_a_second_processor_there_is_none(missions, monkeypatch):
    others = multiprocessing.active_children()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    with compiling_beside(missions):
        assert started_since(others) == []


def test_it_ends_with_a_parent_that_is_killed():
    code = (
        "import multiprocessing, time\n"
        "from service.ingest.kernel_helper import compiling_beside\n"
        "if __name__ == '__main__':\n"
        "    with compiling_beside({}):\n"
        "        print(multiprocessing.active_children()[0].pid, flush=True)\n"
        "        time.sleep(60)\n"
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
    raise AssertionError(f"the helper {pid} is still there")
