"""How often tests of endurance try: a fiftieth of their full size, or all of it (`--torture`).

Another share is given in the environment, such as TEST_TORTURE=0.3.
"""

import os

SHARE = 50
VARIABLE = "TEST_TORTURE"


def size(full: int) -> int:
    """How often to try what a torture tries `full` times."""
    given = os.environ.get(VARIABLE)
    return max(1, int(full * float(given)) if given else full // SHARE)
