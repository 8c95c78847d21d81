"""Damaged files are read or refused in words: never a crash, never memory without bound."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutations import NAMES
from tests.scale import size

MUTATIONS = 1_000_000
"""In all, under --torture."""


@pytest.mark.torture
@pytest.mark.parametrize("reader", NAMES)
def test_a_mutated_file_is_read_or_refused(reader, seed):
    command = [
        sys.executable,
        "-m",
        "tests.mutations",
        reader,
        str(size(MUTATIONS) // 10),
        str(seed),
    ]
    reading = subprocess.run(
        command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False
    )
    assert reading.returncode == 0, reading.stderr
    assert int(reading.stdout) > 0
