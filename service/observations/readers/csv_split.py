"""One line of comma-separated values as its cells."""

import csv


def split_row(body: bytes) -> list[str] | None:
    """The cells of a line; None where it is not a row of comma-separated values."""
    try:
        return next(csv.reader([body.decode()], strict=True))
    except (csv.Error, UnicodeDecodeError, StopIteration):
        return None
