"""A telemetry file's lines by number, a fault in the place of one too long to be held."""

import codecs
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from service.errors import Fault

MAX_LINE_BYTES = 1 << 20


@dataclass(frozen=True)
class Line:
    """A batch as JSON, or the fault that stands in its place.

    `number` counts lines from one; a batch of a CSV file has that of its first
    row, a fault that of the line where it lies.
    """

    number: int
    body: bytes | None
    fault: Fault | None = None


def physical_lines(stream: BinaryIO, number: int = 0) -> Iterator[Line]:
    """The lines of a stream without their ends, after the first `number` that were read already.

    Blank lines are counted and left out.  A line beyond `MAX_LINE_BYTES` is passed
    over without being held.
    """
    while raw := stream.readline(MAX_LINE_BYTES + 1):
        number += 1
        if number == 1:
            raw = raw.removeprefix(codecs.BOM_UTF8)
        if len(raw) > MAX_LINE_BYTES and not raw.endswith(b"\n"):
            length = len(raw)
            while raw and not raw.endswith(b"\n"):
                raw = stream.readline(MAX_LINE_BYTES)
                length += len(raw)
            message = f"is longer than {MAX_LINE_BYTES} bytes"
            yield Line(number, None, Fault(f"line {number}", message, f"{length} bytes"))
        elif raw.strip():
            yield Line(number, raw.rstrip(b"\r\n"))
