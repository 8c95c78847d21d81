"""Arguments that are checked as they are read."""

import argparse


def count(text: str) -> int:
    """A whole number of at least one."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1 (got {text!r})")
    return number


def table(text: str) -> int | str:
    """The number of a table, or the name of one such as ptp-5."""
    return count(text) if text.lstrip("-").isdigit() else text


def speed(text: str) -> float | None:
    """A factor above zero; None for `max`."""
    if text == "max":
        return None
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 0 < factor < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number above 0, or max (got {text!r})")
    return factor
