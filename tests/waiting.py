"""Waits for what another thread or process does, and the processes that a process started."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

Value = TypeVar("Value")


def wait_until(
    condition: Callable[[], Value],
    seconds: float = 30.0,
    *,
    why: str | Callable[[], object] = "the condition stayed false",
    every_s: float = 0.01,
) -> Value:
    """The first value of `condition()` that counts as true; AssertionError after `seconds`.

    `seconds` only ends a test that would hang.  It is not a promise about speed, so that it can
    be long: the machine is shared.  `why` is the message, or makes it when the time is up.
    """
    give_up_s = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > give_up_s:
            message = why() if callable(why) else why
            raise AssertionError(f"waited {seconds:g} s: {message}")
        time.sleep(every_s)
    return value


def children_of(pid: int) -> set[int]:
    """The processes that a process has started, and those that these have."""
    found: set[int] = set()
    # A process may end while it is looked at.
    with suppress(OSError):
        for file in Path(f"/proc/{pid}/task").glob("*/children"):
            found.update(map(int, file.read_text().split()))
    return found.union(*map(children_of, found))
