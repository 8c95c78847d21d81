"""One line of comma-separated values as its cells."""

import csv

from service.observations.readers.lines import MAX_LINE_BYTES

# The sums of the lines of a raster are one cell, and larger than the module's own limit.
csv.field_size_limit(MAX_LINE_BYTES)


def split_row(body: bytes) -> list[str] | None:
    """The cells of a line; None where it is not a row of comma-separated values."""
    try:
        return next(csv.reader([body.decode()], strict=True))
    except (csv.Error, UnicodeDecodeError, StopIteration):
        return None
