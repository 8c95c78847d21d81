"""Damaged files are read or refused in words: never a crash, never memory without bound."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutations import NAMES, BlackBox
from tests.scale import size

CHECKOUT = Path(__file__).parents[1]
MUTATIONS, IN_A_SITTING = 1_000_000, 500
"""Of each reader's file."""
SHOWN = 4_000
ENOUGH_TO_READ_ONE = 5_000
"""Of the readers whose formats have checksums, one mutated file in two hundred is read."""


class ReadingProcess:
    """A process that reads the files of one reader after another."""

    def __init__(self, folder):
        self._box, self._complaints = folder / "read", folder / "complaints"
        command = [sys.executable, "-m", "tests.mutations", str(self._box)]
        with self._complaints.open("wb") as stderr:
            self.process = subprocess.Popen(
                command,
                cwd=CHECKOUT,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
            )

    def counted(self, reader, count, seed):
        """What came of the mutations; where the process ends, the file that did it is told."""
        self.process.stdin.write(f"{reader} {count} {seed}\n")
        self.process.stdin.flush()
        if line := self.process.stdout.readline():
            return json.loads(line)
        # Decoders complain of much that they find; what ended the reading comes last.
        complaints = self._complaints.read_bytes()[-2 * SHOWN :].decode(errors="replace")
        name, data = BlackBox.read(self._box)
        code = self.process.wait()
        pytest.fail(f"exit code {code}: {complaints}\n{name}: {repr(data)[:SHOWN]}")


@pytest.fixture(scope="module")
def reading(tmp_path_factory):
    """The process that reads; another one, where it has ended."""
    started = []

    def process():
        if not started or started[-1].process.poll() is not None:
            started.append(ReadingProcess(tmp_path_factory.mktemp("mutations")))
        return started[-1]

    yield process
    for each in started:
        each.process.communicate()


@pytest.mark.torture
@pytest.mark.parametrize("reader", NAMES)
def test_a_mutated_file_is_read_or_refused(reader, seed, figures, reading):
    count = size(MUTATIONS, least=IN_A_SITTING)
    counted = reading().counted(reader, count, seed)
    figures(mutations=count, **counted)
    assert counted["read"] + counted["refused"] == count
    if count >= ENOUGH_TO_READ_ONE:
        assert counted["read"] > 0
    assert counted["refused"] > 0
