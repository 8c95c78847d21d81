"""How much the tests try in each of the three commands.

|                  | `make test`   | `make full`     | `make torture` |
| `size(1_000)`    | once          | a fiftieth: 20  | 1,000          |
| `size(1_000, 5)` | 5             | 20              | 1,000          |
| `draws(50, 200)` | 50            | 200             | 200            |

Another share of `size` is given in the environment, such as TEST_TORTURE=0.3.
"""

import os
from collections.abc import Sequence
from typing import Any

import pytest

FULL_SHARE = 1 / 50
VARIABLE = "TEST_TORTURE"
FULL = "TEST_FULL"


def size(full: int, least: int = 1) -> int:
    """How often to try what a torture tries `full` times; `make test` tries it `least` times."""
    given = os.environ.get(VARIABLE)
    share = float(given) if given else FULL_SHARE if is_full() else 0.0
    return max(least, round(full * share))


def draws(sitting: int, full: int) -> int:
    """How many random cases to draw: `sitting` in `make test`, `full` in `make full`.

    Only for a promise whose bound a wrong build still fails with the smaller number.
    """
    return full if is_full() else sitting


def some_in_a_sitting(values: Sequence[Any]) -> list[Any]:
    """Parameters of which `make test` takes the first, the middle and the last."""
    chosen = {0, len(values) // 2, len(values) - 1}
    return [
        value if index in chosen else pytest.param(value, marks=pytest.mark.slow)
        for index, value in enumerate(values)
    ]


def at_full_size() -> bool:
    """Whether this is `make torture`, which has the machine for itself."""
    return os.environ.get(VARIABLE) == "1"


def is_full() -> bool:
    """Whether everything is to be tested, not only what fits into a sitting."""
    return bool(os.environ.get(FULL) or os.environ.get(VARIABLE))
