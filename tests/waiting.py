"""Waits for what another thread or process does, instead of sleeping for a guessed time."""

import time
from collections.abc import Callable
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
