"""The lines of a telemetry file, in groups that are computed together.

A line is text, or a `Line` with a number of its own and perhaps a fault in place of its text:
the batches of space packets have the numbers of their packets.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from service.errors import BadBatch, BadInput, Fault
from service.observations.readers.lines import Line

MAX_BLANK_LINES = 1_000_000
"""Of a file.  They hold nothing, and five gigabytes of them pack to five megabytes."""


@dataclass
class LineGroup:
    """Lines of a file that are not blank, with their numbers from 1.

    `last` is the number of the last line that was read, blank or not.
    """

    last: int = 0
    numbers: list[int] = field(default_factory=list)
    texts: list[bytes] = field(default_factory=list)
    faults: list[tuple[int, Fault]] = field(default_factory=list)
    """Of lines that were refused when they were read, with their numbers."""

    def __len__(self) -> int:
        return len(self.texts) + len(self.faults)

    def add(self, line: Line) -> None:
        """Take a line, or its fault."""
        if line.body is None:
            assert line.fault is not None
            self.faults.append((line.number, line.fault))
        else:
            self.numbers.append(line.number)
            self.texts.append(line.body)


def line_groups(
    lines: Iterable[bytes | Line],
    skipped: int,
    size: Callable[[], int],
    require: Callable[[], object],
) -> Iterator[LineGroup]:
    """The lines after the first `skipped` ones, `size` of them at a time.

    `require` is called before each line, and ends the reading where it raises.  Raises
    `BadBatch` where there are too many blank lines.
    """
    group, read, handed, blank = LineGroup(), 0, 0, 0
    try:
        for line in lines:
            require()
            read += 1
            if read <= skipped:
                handed = read
                continue
            if isinstance(line, Line):
                group.add(line)
            elif line.strip():
                group.add(Line(read, line.rstrip(b"\r\n")))
            else:
                blank += 1
                if blank > MAX_BLANK_LINES:
                    raise BadBatch(Fault("body", f"has more than {MAX_BLANK_LINES} blank lines"))
            group.last = read
            if len(group) >= size():
                yield group
                group, handed = LineGroup(), read
    except BadInput:
        # A damaged or too long file ends here; the lines before the fault are valid.
        if group.last > handed:
            yield group
        raise
    if group.last > handed:
        yield group
