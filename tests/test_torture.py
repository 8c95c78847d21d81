"""`make torture` writes a result for each part, and goes on where it stopped."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]
PARTS = """
import os

import pytest


def test_that_passes(record_property):
    record_property("figures", {"kills": 3, "answers": {201: 5}})


@pytest.mark.parametrize("number", [1, 2])
def test_that_fails_at_first(number):
    assert os.environ.get("MENDED"), "not mended yet"


def test_without_its_database():
    pytest.skip("there is none")
"""


OF_ITS_OWN = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": ""}


@pytest.fixture
def run(tmp_path):
    """Run the parts, or some of them; what pytest printed and all results so far."""
    parts, folder = tmp_path / "test_parts.py", tmp_path / "results"
    parts.write_text(PARTS, "utf-8")
    command = [sys.executable, "-m", "pytest", "-p", "tests.torture", "-p", "no:cacheprovider"]
    command += ["-c", os.devnull, "--rootdir", tmp_path, "-rA", "--torture-results", folder]

    def ran(*arguments, **environment):
        done = subprocess.run(
            [*command, *arguments, parts],
            cwd=CHECKOUT,
            env=os.environ
            | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": ""}
            | environment,
            capture_output=True,
            text=True,
            check=False,
        )
        files = sorted(folder.glob("*.json"))
        return done, [json.loads(file.read_text("utf-8")) for file in files]

    return ran


def test_each_part_has_its_result(run):
    done, results = run()
    assert done.returncode == 1
    *failed, passed = results
    assert passed["part"].endswith("test_parts.py::test_that_passes")
    assert passed["passed"] is True
    assert passed["figures"] == {"kills": 3, "answers": {"201": 5}}
    assert passed["seconds"] >= 0.0
    assert len(passed["given"]["service"]) == 16
    assert set(passed) >= {"commit", "ended"}
    assert [each["passed"] for each in failed] == [False, False]
    assert "not mended yet" in failed[0]["faults"][0]


@pytest.mark.slow
def test_a_run_goes_on_where_one_was_stopped(run):
    run("-k", "passes")
    done, results = run()
    assert "passed at commit" in done.stdout
    assert [each["passed"] for each in results] == [False, False, True]
    done, results = run(MENDED="1")
    assert done.returncode == 0
    assert [each["passed"] for each in results] == [True, True, True]
    done, _ = run()
    assert done.returncode == 0
    assert "4 skipped" in done.stdout


def test_another_size_is_tried_anew(run):
    run("-k", "passes", TEST_TORTURE="0.5")
    done, (result,) = run("-k", "passes", TEST_TORTURE="1")
    assert "1 passed" in done.stdout
    assert result["given"]["size"] == "1"
