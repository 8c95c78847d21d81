"""Writes what came of each torture, and leaves out those that passed with the same code.

    pytest -p tests.torture --torture -m torture      or: make torture

A JSON file for each test, in `.torture` or where --torture-results says: commit, digest of
`service/`, seed, size, figures, whether it passed, seconds.  A run that was stopped goes on where
it was: what passed with the same `service/`, seed and size is skipped.
"""

import hashlib
import json
import os
import re
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.scale import VARIABLE

ROOT = Path(__file__).parents[1]
FIGURES = "figures"
FAULT_CHARACTERS = 8_000
_REPORTS, _BEGUN = pytest.StashKey(), pytest.StashKey()


def pytest_addoption(parser):
    parser.addoption(
        "--torture-results",
        type=Path,
        default=ROOT / ".torture",
        help="folder of the results of tortures",
    )


def pytest_collection_modifyitems(config, items):
    """Skip what passed."""
    now = given(config)
    for item in items:
        file = file_of(item)
        before = json.loads(file.read_text("utf-8")) if file.exists() else {}
        if before.get("passed") and before["given"] == now:
            why = f"passed at commit {before['commit']}, {before['ended']}"
            item.add_marker(pytest.mark.skip(reason=why))


def pytest_runtest_setup(item):
    # The code may be edited while an hour's test runs: what it began with counts.
    item.stash[_BEGUN] = {"commit": commit(), "given": given(item.config)}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    reports = item.stash.setdefault(_REPORTS, [])
    reports.append(report)
    if report.when == "teardown" and not any(each.skipped for each in reports):
        write(file_of(item), result_of(item, reports))
    return report


def result_of(item, reports):
    """The result of one test, of the reports of its three steps."""
    faults = [each.longreprtext[-FAULT_CHARACTERS:] for each in reports if each.failed]
    return {
        "part": item.nodeid,
        **item.stash[_BEGUN],
        "passed": not faults,
        "seconds": round(sum(each.duration for each in reports), 1),
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
        "figures": dict(item.user_properties).get(FIGURES),
        "faults": faults,
    }


def given(config):
    """What a result depends on."""
    return {
        "service": digest_of(ROOT / "service"),
        "seed": config.getoption("--seed", None),
        "size": os.environ.get(VARIABLE),
    }


def digest_of(folder):
    """A digest of all files of a folder but compiled ones, by their paths and their bytes."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(f"{path.relative_to(folder)}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def commit():
    """The commit that is checked out; None where there is no repository."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return ran.stdout.strip() or None


def file_of(item):
    """Where the result of a test is kept."""
    name = re.sub(r"[^\w.]+", "-", item.nodeid).strip("-")
    return item.config.getoption("--torture-results") / f"{name}.json"


def write(file, result):
    """Keep a result; a run that is killed meanwhile leaves the one before."""
    file.parent.mkdir(parents=True, exist_ok=True)
    beside = file.with_suffix(".new")
    beside.write_text(json.dumps(result, indent=1, default=str) + "\n", "utf-8")
    beside.replace(file)
