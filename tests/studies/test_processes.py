"""The processes of a simulation end with the command that started them."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

PATIENCE_S = 60.0
COMMANDS = {
    "mission": ("mission", "XTE", "--stars", "10000000", "--quiet"),
    "fink_shoup": ("paper", "--table", "3", "--stars", "10000000"),
    "zhou_ye": ("paper", "--table", "ptp-6", "--scenes", "10000000"),
}


def children_of(pid):
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    return [int(each) for each in found if "spawn_main" in _command(each)]


def _command(pid):
    return Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8")


def is_there(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2][1] != "Z"
    except FileNotFoundError:
        return False


def wait_for(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.1)


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
@pytest.mark.slow("mission", "zhou_ye")
def test_they_end_with_a_command_that_is_killed(command):
    with subprocess.Popen(
        [sys.executable, "-m", "service.cli", "simulate", *command, "--processes", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as parent:
        try:
            wait_for(lambda: len(children_of(parent.pid)) == 2)
            children = children_of(parent.pid)
        finally:
            parent.kill()
    wait_for(lambda: not any(map(is_there, children)))
