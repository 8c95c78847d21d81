"""How often tests of endurance try: a fiftieth of their full size, or all of it (`--torture`)."""

import os

SHARE = 50
VARIABLE = "TEST_TORTURE"


def size(full: int) -> int:
    """How often to try what a torture tries `full` times."""
    return full if os.environ.get(VARIABLE) else max(1, full // SHARE)
