"""Other programs that read what the service writes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


class Orekit:
    """Orekit in a process of its own."""

    def __init__(self):
        worker = Path(__file__).parent / "orekit_worker.py"
        self._process = subprocess.Popen(
            [sys.executable, str(worker)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def read(self, kind, file, shift_s=0.0):
        """What Orekit finds in a file; `shift_s` moves each state by its own rate."""
        return self.ask(kind=kind, file=str(file), shift_s=shift_s)

    def ask(self, **asked):
        """What a function of the worker answers."""
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        assert "error" not in answer, answer["error"]
        return answer["found"]

    def close(self):
        self._process.stdin.close()
        self._process.wait(30)
        self._process.stdout.close()


@pytest.fixture(scope="session")
def orekit():
    reader = Orekit()
    yield reader
    reader.close()
