"""Runs in the copy of the tree that `tests.mutants` makes, as `service.fault_probe`.

Each place that may be faulty asks `is_on`, in every process that the tests start.  In the first run
no fault is on, and it notes which test was running; in a later run the fault that the environment
names is on.  pytest has the same module as a plugin (-p service.fault_probe), which tells the other
processes the running test, chooses tests and writes their outcomes.
"""

import json
import mmap
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

FOLDER = "FAULT_FOLDER"
"""Where a run writes; `chosen.json` in it holds the tests to run, in their order."""
ACTIVE = "FAULT_ACTIVE"
"""The number of the fault that is on; without it places are noted."""
RUNNING = "FAULT_RUNNING"
"""The file that holds the running test, of whichever process of pytest started this one."""
NOTES, OUTCOMES, CHOSEN = "reached.jsonl", "outcomes.jsonl", "chosen.json"
_LONGEST_NAME = 4096

_active = int(os.environ[ACTIVE]) if ACTIVE in os.environ else None
_noted: set[tuple[int, bytes]] = set()
_running: mmap.mmap | None = None
_reports: dict[str, dict[str, Any]] = {}
_is_worker = False


def is_on(place: int) -> bool:
    """True if the fault of this place is on."""
    if _active is None and FOLDER in os.environ:
        _note(place)
    return place == _active


def _note(place: int) -> None:
    test = _running_test()
    if (place, test) not in _noted:
        _noted.add((place, test))
        line = json.dumps([place, test.decode("utf-8", "replace")])
        # A test may take the disk or the files from its process.
        with suppress(OSError), (Path(os.environ[FOLDER]) / NOTES).open("a") as notes:
            notes.write(line + "\n")


def _running_test() -> bytes:
    """The running test; empty while pytest still imports."""
    global _running
    if _running is None:
        if RUNNING not in os.environ:
            return b""
        with open(os.environ[RUNNING], "r+b") as file:
            _running = mmap.mmap(file.fileno(), _LONGEST_NAME)
    return _running[: _running.find(b"\0")]


def pytest_configure(config: Any) -> None:
    """Make the file of the running test, which processes read that are started from now on."""
    global _running, _is_worker
    _is_worker = hasattr(config, "workerinput")
    file = Path(os.environ[FOLDER]) / f"running-{os.getpid()}"
    file.write_bytes(bytes(_LONGEST_NAME))
    os.environ[RUNNING] = str(file)
    _running = None


def pytest_runtest_logstart(nodeid: str) -> None:
    _running_test()
    assert _running is not None
    name = nodeid.encode()[: _LONGEST_NAME - 1]
    _running[: len(name) + 1] = name + b"\0"


def pytest_runtest_logreport(report: Any) -> None:
    """Write the outcome of a test after its teardown, once: not in the workers of pytest-xdist."""
    if _is_worker:
        return
    outcome = {"test": report.nodeid, "seconds": 0.0, "call_s": 0.0, "failed": False}
    outcome = _reports.setdefault(report.nodeid, outcome)
    outcome["seconds"] += report.duration
    outcome["failed"] |= report.failed
    if report.when == "call":
        outcome["call_s"] = report.duration
    if report.when == "teardown":
        with (Path(os.environ[FOLDER]) / OUTCOMES).open("a") as file:
            file.write(json.dumps(_reports.pop(report.nodeid)) + "\n")


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    chosen = Path(os.environ[FOLDER]) / CHOSEN
    if chosen.exists():
        rank = {test: at for at, test in enumerate(json.loads(chosen.read_text("utf-8")))}
        items[:] = sorted(
            (item for item in items if item.nodeid in rank), key=lambda item: rank[item.nodeid]
        )
