"""A healthy client beside hostile ones: how long its posts take, and what the server holds."""

import json
import resource
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.scale import at_full_size

TRIES = 3
"""Other work on the machine delays a post now and then; what clients do shows every time."""
LEAST_P99_MS = 5.0
"""Below that a delay by twice as much is nobody's loss, and the machine's own noise."""
MORE_MEMORY_MB = 50
"""What hostile clients may add to what the server holds."""


def resident_mb(process):
    """What the server's processes hold."""
    pages = sum(
        int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in family(process.pid)
    )
    return pages * resource.getpagesize() / 1e6


def family(pid):
    """A process and all that it started."""
    yield pid
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in children.read_text().split():
            yield from family(int(child))


def answers(client, batch, names, count):
    """Healthy requests, each of which must be answered as ever; how long each took, in ms."""
    taken = []
    for _ in range(count):
        content = json.dumps(batch | {"batch": next(names)})
        begun = time.perf_counter()
        answer = client.post(
            "/api/v1/batches", content=content, headers={"Content-Type": "application/json"}
        )
        taken.append(1e3 * (time.perf_counter() - begun))
        assert answer.status_code == 201, answer.text
    return taken


def p99(taken):
    return float(np.percentile(taken, 99))


@dataclass(frozen=True)
class Tried:
    """The 99th percentile of healthy requests in ms, beside trouble and without, and memory."""

    beside: float
    without: float
    more_mb: float

    @property
    def slower(self):
        return self.beside / max(self.without, LEAST_P99_MS)

    def __str__(self):
        return f"p99 {self.beside:.1f} ms, without {self.without:.1f} ms, {self.more_mb:+.1f} MB"


def tries(process, alone, beside):
    """Healthy requests alone, beside trouble, and alone again; once more where it was disturbed.

    How much longer they take is held only at full size, where the machine does nothing else.
    """
    tried = []
    most = TRIES if at_full_size() else 1
    while len(tried) < most and not (tried and tried[-1].slower < 2.0):
        without = alone()
        before_mb = resident_mb(process)
        taken, mb = beside()
        without += alone()
        tried.append(Tried(p99(taken), p99(without), mb - before_mb))
    assert max(each.more_mb for each in tried) < MORE_MEMORY_MB
    assert tried[-1].slower < 2.0 or not at_full_size(), list(map(str, tried))
    return tried
