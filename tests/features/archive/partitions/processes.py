"""The command `acquire reprocess` and Dask's own commands as processes to be killed."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.waiting import children_of, wait_until

CHECKOUT = Path(__file__).parents[4]
WAIT_S = 240.0


def begin_command(database, place, run="again", **options):
    """Start `acquire reprocess` into an archive; options as --name value."""
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    command = [sys.executable, "-m", "service.cli", "reprocess", "--archive", str(place)]
    command += ["--database", database, "--run", run, "--no-comparison", "--quiet", *given]
    return subprocess.Popen(
        command, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def run_command(*given, **options):
    """The output of the command, which must end well."""
    process = begin_command(*given, **options)
    output, complaints = process.communicate(timeout=10 * WAIT_S)
    assert process.returncode == 0, complaints
    return output


def end(process):
    """Kill a process that is still there; whether it was."""
    was_there = process.poll() is None
    process.kill()
    process.communicate()
    return was_there


def workers_of(pid):
    """The processes that compute for another one: forked by its fork server."""
    servers = [each for each in children_of(pid) if b"forkserver" in _command(each)]
    # Those that are forked have its command line.
    return {child for each in servers for child in children_of(each)}


def _command(pid):
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    return b""


def kill_a_child(pid, rng):
    """Kill one of the processes that compute for another one; whether there was one."""
    found = sorted(workers_of(pid))
    if not found:
        return False
    try:
        os.kill(int(rng.choice(found)), signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


@contextmanager
def dask_process(*words, environment=None):
    """One of Dask's commands, killed at the end."""
    command = [sys.executable, "-m", "dask", *words]
    process = subprocess.Popen(
        command,
        cwd=CHECKOUT,
        env=os.environ | (environment or {}),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def scheduler(folder):
    """A scheduler on a port of its own, and its address."""
    import json

    file = folder / "scheduler.json"
    words = ("--port", "0", "--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file))
    # Workers are killed here on purpose.
    often = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1000"}
    with dask_process("scheduler", *words, environment=often):
        wait_until(
            lambda: file.exists() and file.read_text().endswith("}"),
            WAIT_S,
            why="the scheduler has not started",
        )
        yield json.loads(file.read_text())["address"]


def dask_worker(address):
    """A worker of a scheduler, with one thread."""
    return dask_process(
        "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"
    )
