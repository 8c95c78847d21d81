"""Damaged files are read or refused in words: never a crash, never memory without bound."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutations import NAMES
from tests.scale import size

CHECKOUT = Path(__file__).parents[1]
MUTATIONS = 1_000_000
"""Of each reader's file, under --torture."""


@pytest.mark.torture
@pytest.mark.parametrize("reader", NAMES)
def test_a_mutated_file_is_read_or_refused(reader, seed, figures, tmp_path):
    count = size(MUTATIONS)
    command = [sys.executable, "-m", "tests.mutations", reader, str(count), str(seed)]
    complaints = tmp_path / "complaints"
    with complaints.open("wb") as stderr:
        reading = subprocess.run(
            command, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=stderr, text=True, check=False
        )
    # Decoders complain of much that they find; what ended the reading comes last.
    assert reading.returncode == 0, complaints.read_bytes()[-8000:].decode(errors="replace")
    told = json.loads(reading.stdout)
    figures(mutations=count, **told)
    assert told["read"] + told["refused"] == count
    assert told["read"] > 0
    assert told["refused"] > 0
