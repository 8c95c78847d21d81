"""Samples of two blocks that were taken at the same time."""

import numpy as np

from service.errors import Conflict
from service.gyro.block import Nanoseconds

SAME_TIME_NS = 1_000
"""Samples nearer than this have the same time.

Times are sent with a start that is rounded and steps that are added up, so the same sample in two
blocks may differ by some nanoseconds.
"""


class SampleTaken(Conflict):
    """A sample at a time that another block of the spacecraft and the run holds."""


def first_shared_ns(times_ns: Nanoseconds, others_ns: Nanoseconds) -> int | None:
    """The first of the times that another block holds, or None; both in rising order."""
    place = np.searchsorted(others_ns, times_ns)
    after = others_ns[np.minimum(place, others_ns.size - 1)]
    before = others_ns[np.maximum(place - 1, 0)]
    distance = np.minimum(np.abs(after - times_ns), np.abs(times_ns - before))
    shared = np.flatnonzero(distance < SAME_TIME_NS)
    return int(times_ns[shared[0]]) if shared.size else None
