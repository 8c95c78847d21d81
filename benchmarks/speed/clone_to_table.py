"""The first minute: from a fresh clone to the table of `make run`, beside a commit before.

    python -m benchmarks clone_to_table

The last commit of this tree and `BASE` in turns, each cloned into a folder of its own, with the
Python that runs this.  A clone of either comes before and is not counted: what it downloads is
there for the others.  Uncommitted changes are not measured.  Without anything else on the
machine; an empty loop is timed beside it.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.bounds import Bound, at_most
from benchmarks.compare.servers import HERE, commit_of
from benchmarks.report import Report
from benchmarks.speed.compiling import BASE, empty_loop_s
from benchmarks.speed.serving import free_port

TURNS, QUICK_TURNS = 2, 1
MOST_OF_BASE = 0.5
"""Largest ratio of the time from the clone to the table to that of `BASE`."""
MOST_READY_OF_BASE = 0.35
"""Largest ratio of the time until batches with an a priori attitude are answered."""
_THAT_TOOK = re.compile(r"^That took ([0-9.]+) s, ([0-9.]+) s of them until the server was ready")


class FirstMinute(NamedTuple):
    """Seconds until the clone was there, the packages installed, batches answered, the table."""

    cloned: float
    installed: float
    ready: float
    table: float


def run(quick: bool, seed: int) -> Report:
    """The benchmark; there is nothing random in it."""
    commits = {"now": commit_of("HEAD"), BASE: commit_of(BASE)}
    figures: dict[str, Any] = {}
    least: dict[str, FirstMinute] = {}
    for turn in range(1 + (QUICK_TURNS if quick else TURNS)):
        for name, commit in commits.items():
            found = _first_minute(commit)
            if turn == 0:
                continue
            least[name] = min(least.get(name, found), found, key=lambda each: each.table)
            figures[f"{name}, turn {turn}: cloned after, s"] = found.cloned
            figures[f"{name}, turn {turn}: installed after, s"] = found.installed
            figures[f"{name}, turn {turn}: first batches answered after, s"] = found.ready
            figures[f"{name}, turn {turn}: table after, s"] = found.table
    figures["empty loop of ten million rounds, s"] = empty_loop_s()
    now, before = least["now"], least[BASE]
    until_ready = (now.ready - now.installed) / (before.ready - before.installed)
    bounds: list[Bound] = [
        at_most(f"clone to table over {BASE}", now.table / before.table, MOST_OF_BASE),
        at_most(f"first batches answered over {BASE}", until_ready, MOST_READY_OF_BASE),
    ]
    return Report("clone_to_table", figures, bounds)


def _first_minute(commit: str) -> FirstMinute:
    """Clone a commit and run it until it has printed its table."""
    # What a site tells of kernels, packages and settings stays; what this process has does not.
    environment = {
        name: text
        for name, text in os.environ.items()
        if name not in ("NUMBA_CACHE_DIR", "PYTHONPATH", "VIRTUAL_ENV")
    }
    python = Path(sys.base_prefix) / "bin" / "python3"
    with tempfile.TemporaryDirectory() as name:
        clone = Path(name) / "clone"
        started = time.monotonic()
        for command in (
            ["git", "clone", "--quiet", "--no-local", str(HERE), str(clone)],
            ["git", "-C", str(clone), "checkout", "--quiet", commit],
        ):
            subprocess.run(command, check=True)
        cloned_s = time.monotonic() - started
        run = ["make", "run", f"PYTHON={python}", f"PORT={free_port()}", "DEMO_ARGS=--once"]
        printed = subprocess.Popen(
            run,
            cwd=clone,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        )
        assert printed.stdout is not None
        lines = []
        for line in printed.stdout:
            lines.append(line)
            if match := _THAT_TOOK.match(line):
                table_s = time.monotonic() - started
                demo_s, ready_s = map(float, match.groups())
        if printed.wait() != 0:
            raise RuntimeError(f"make run of {commit} failed:\n{''.join(lines[-20:])}")
    installed_s = table_s - demo_s
    return FirstMinute(cloned_s, installed_s, installed_s + ready_s, table_s)
