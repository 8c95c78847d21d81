"""A CSV file as a table: its separator, header and decimal mark, and its rows batch by batch.

Spreadsheets write commas, semicolons or tabs between cells, perhaps a line `sep=;` before the
header, and in some languages decimal commas.  A file is read once before any row is handed on:
that shows whether rows of one batch lie apart, as in a file sorted by magnitude or by tracker.
Such rows are then handed on together, the batches in order of time.
"""

import csv
import re
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from service.csv_cells import original
from service.errors import BadFile, BadInput, Fault, shown_value
from service.observations.decompress import MAX_LINE_BYTES, Line, physical_lines
from service.times import parse_utc

# The sums of the lines of a raster are one cell, and larger than the module's own limit.
csv.field_size_limit(MAX_LINE_BYTES)

SEPARATORS = (",", ";", "\t", "|")
MOST_GROUPS = 8_000_000
"""Groups of consecutive rows of one batch in a file; 16 bytes of each are held."""
MOST_ROWS_APART = 4_000_000
"""Rows of a file in which rows of one batch lie apart; 32 bytes of each are held."""

_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?[,;\t|]*', re.IGNORECASE)

CsvRow = dict[str, str]


@dataclass(frozen=True)
class RowKind:
    """The columns of a kind of rows, and which of them tell the rows of one batch or block."""

    noun: str
    key: tuple[str, str, str]
    """Spacecraft, run and name; only the run may be empty."""
    columns: Sequence[str]
    texts: frozenset[str]
    """Columns that do not hold numbers."""
    verbatim: frozenset[str]
    """Columns whose cells are taken with their spaces; around other cells spaces do no harm."""
    check_header: Callable[[list[str], str], None]
    """Raises `BadFile` for names of columns, and the place where they are."""
    ordered_by_time: bool
    """True if rows of one batch that lie apart are put in order of time."""


@dataclass(frozen=True)
class Row:
    """A row by column; `cells` is None where it cannot be told whose row it is."""

    number: int
    cells: CsvRow | None
    fault: Fault | None = None


@dataclass(frozen=True)
class _Place:
    """The place of a row in the file: the end of the row before it, and the number of its line."""

    offset: int
    number: int


class CsvTable:
    """The rows of a CSV file; `kind` is that of its header."""

    def __init__(self, stream: BinaryIO, kinds: Sequence[RowKind]) -> None:
        """Reads the whole file once, which must be seekable.

        Raises `BadFile` for the header, for decimal commas beside decimal points, and for rows
        of one batch that lie apart and cannot be brought together.
        """
        self._stream = stream
        self._decimal_comma = False
        header = self._header(kinds)
        self._names = _lower(header)
        while len(self._names) > 1 and not self._names[-1]:
            self._names.pop()
        self.kind = _kind_of(self._names, kinds)
        where = f"line {self._header_line}"
        spacecraft, _, name = self.kind.key
        if not {spacecraft, name} & set(self._names):
            message = (
                "is no header of batches or gyro samples: a row of names such as "
                f"{','.join(self.kind.columns[:4])} is expected, between commas, semicolons or tabs"
            )
            raise BadFile(Fault(where, message, shown_value(",".join(header))))
        self.kind.check_header(self._names, where)
        self._number_columns = [
            k for k, name in enumerate(self._names) if name not in self.kind.texts
        ]
        self._key_columns = [
            self._names.index(name) if name in self._names else None for name in self.kind.key
        ]
        apart = self._survey()
        self._places = None if apart is None else self._together(apart)

    def rows(self) -> Iterator[Row]:
        """The rows in their order, those of one batch together; can be called once."""
        for line in self._lines() if self._places is None else self._lines_at(self._places):
            if (row := self._row(line)) is not None:
                yield row

    def _header(self, kinds: Sequence[RowKind]) -> list[str]:
        """The names of the columns, after comments that begin with `#`; finds the separator."""
        lines = (
            line for line in physical_lines(self._stream) if not (line.body or b"").startswith(b"#")
        )
        line = next(lines, None)
        text = "" if line is None or line.body is None else line.body.decode("utf-8", "replace")
        declared = _SEPARATOR_LINE.fullmatch(text)
        if declared is not None:
            line = next(lines, None)
        if line is None or line.body is None:
            fault = line.fault if line is not None else None
            raise BadFile(fault or Fault("line 1", "there is no header"))
        self._header_line, self._rows_start = line.number, self._stream.tell()
        known = {name for kind in kinds for name in kind.columns}
        self._separator = "," if declared is None else declared[1]
        header = _split(line.body, self._separator)
        for separator in SEPARATORS if declared is None else ():
            names = _split(line.body, separator) or []
            if len(known.intersection(_lower(names))) > len(
                known.intersection(_lower(header or []))
            ):
                header, self._separator = names, separator
        if header is None:
            message = "is not a row of comma-separated values"
            raise BadFile(Fault(f"line {line.number}", message, shown_value(line.body)))
        return header

    def _lines(self) -> Iterator[Line]:
        """The lines after the header, in the order of the file."""
        self._stream.seek(self._rows_start)
        return physical_lines(self._stream, self._header_line)

    def _lines_at(self, places: Iterator[_Place]) -> Iterator[Line]:
        for place in places:
            self._stream.seek(place.offset)
            line = next(physical_lines(self._stream, self._header_line))
            yield replace(line, number=place.number)

    def _cells(self, line: Line) -> list[str] | Fault:
        """The cells of a line, none of a row that is empty or the header again."""
        if line.body is None:
            return line.fault or Fault(f"line {line.number}", "cannot be read")
        found = _split(line.body, self._separator)
        if found is None:
            message = "is not a row of comma-separated values"
            return Fault(f"line {line.number}", message, shown_value(line.body))
        count = len(self._names)
        if len(found) > count and not any(each.strip() for each in found[count:]):
            del found[count:]
        if not any(found) or not any(each.strip() for each in found):
            return []
        if found[0].strip().lower() == self._names[0] and _lower(found) == self._names:
            return []
        return found

    def _key(self, found: Sequence[str]) -> tuple[str, ...] | None:
        """The texts that tell the batch of a row; None where it cannot be told."""
        spacecraft, run, name = (
            "" if k is None else found[k] if k < len(found) else None for k in self._key_columns
        )
        return (spacecraft, run, name) if spacecraft and run is not None and name else None

    def _row(self, line: Line) -> Row | None:
        """The row of a line; None for one without a cell, and for the header again."""
        found = self._cells(line)
        if isinstance(found, Fault):
            return Row(line.number, None, found)
        if not found:
            return None
        fault = None
        if len(found) != len(self._names):
            message = f"has {len(found)} cells; the header has {len(self._names)}"
            fault = Fault(f"line {line.number}", message)
        if self._key(found) is None:
            message = f"does not name its spacecraft and {self.kind.noun}"
            return Row(line.number, None, fault or Fault(f"line {line.number}", message))
        cells: CsvRow = {}
        for name, cell in zip(self._names, found, strict=False):
            if name not in self.kind.texts:
                # An apostrophe marks a text for a spreadsheet, a number among them.
                cell = cell.strip().removeprefix("'")
                cells[name] = cell.replace(",", ".") if self._decimal_comma else cell
            else:
                cells[name] = original(cell if name in self.kind.verbatim else cell.strip())
                if name == "time":
                    cells[name] = _with_point(cells[name])
        return Row(line.number, cells, fault)

    def _survey(self) -> int | None:
        """Read all rows; returns the first line whose batch an earlier group of rows began."""
        keys, firsts = array("q"), array("Q")
        marks: dict[str, int] = {}
        last = None
        for line in self._lines():
            found = self._cells(line)
            if isinstance(found, Fault) or not found:
                continue
            if len(marks) < 2:
                for k in self._number_columns:
                    for mark in ",.":
                        if k < len(found) and mark in found[k]:
                            marks.setdefault(mark, line.number)
            key = self._key(found)
            if key is not None and key != last:
                keys.append(hash(key))
                firsts.append(line.number)
                last = key
                if len(keys) > MOST_GROUPS:
                    message = f"is beyond {MOST_GROUPS:,} groups of rows: split the file"
                    raise BadFile(Fault(f"line {line.number}", message))
        if len(marks) == 2 and self._separator != ",":
            first, second = marks
            names = {",": "a decimal comma", ".": "a decimal point"}
            message = (
                f"has a number with {names[second]}, but line {marks[first]} one with "
                f"{names[first]}: thousands separators are not read"
            )
            raise BadFile(Fault(f"line {marks[second]}", message))
        # Between commas a cell with both is refused by itself: its comma separates thousands.
        self._decimal_comma = list(marks) == [","]
        _, begun = np.unique(np.array(keys), return_index=True)
        again = np.ones(len(keys), bool)
        again[begun] = False
        return int(firsts[int(np.argmax(again))]) if again.any() else None

    def _together(self, apart: int) -> Iterator[_Place]:
        """The places of all rows, those of one batch together and batches in order of time."""
        keys, times_ns, offsets, numbers = array("q"), array("q"), array("Q"), array("Q")
        noun = self.kind.noun
        time = self._names.index("time")
        end = self._rows_start
        for line in self._lines():
            offset, end = end, self._stream.tell()
            found = self._cells(line)
            key = None if isinstance(found, Fault) else self._key(found)
            if isinstance(found, list) and not found:
                continue
            if key is None or isinstance(found, Fault):
                message = (
                    f"cannot be read, and rows of one {noun} lie apart (line {apart}): it may "
                    f"belong to any {noun} of the file"
                )
                raise BadFile(Fault(f"line {line.number}", message))
            if len(keys) == MOST_ROWS_APART:
                message = (
                    f"rows of one {noun} lie apart (line {apart}), and no more than "
                    f"{MOST_ROWS_APART:,} rows are brought together: sort the file by "
                    f"{', '.join(self.kind.key)}, or split it"
                )
                raise BadFile(Fault(f"line {line.number}", message))
            keys.append(hash(key))
            times_ns.append(_time_ns(found[time] if time < len(found) else ""))
            offsets.append(offset)
            numbers.append(line.number)
        order = _order(np.array(keys), np.array(times_ns), self.kind.ordered_by_time)
        return (_Place(offsets[k], numbers[k]) for k in order.tolist())


def _order(
    keys: npt.NDArray[np.int64], times_ns: npt.NDArray[np.int64], ordered_by_time: bool
) -> npt.NDArray[np.int64]:
    """The order of rows: by the first time of their batch, the batch, and their own place."""
    _, first, batch = np.unique(keys, return_index=True, return_inverse=True)
    earliest = np.full(len(first), np.iinfo(np.int64).max)
    np.minimum.at(earliest, batch, times_ns)
    within = times_ns if ordered_by_time else np.zeros_like(times_ns)
    return np.lexsort((within, first[batch], earliest[batch]))


def _time_ns(text: str) -> int:
    """The time of a row; 0 for one that cannot be read, which is refused later."""
    try:
        return parse_utc(_with_point(text.strip())).tai_ns
    except BadInput:
        return 0


def _with_point(time: str) -> str:
    """A time whose decimal mark, in ISO 8601 a comma or a point, is a point."""
    return time.replace(",", ".")


def _lower(names: Sequence[str]) -> list[str]:
    return [name.strip().lower() for name in names]


def _kind_of(names: list[str], kinds: Sequence[RowKind]) -> RowKind:
    """The kind that most of the names belong to, the first of equals."""
    return max(kinds, key=lambda kind: len(set(names) & set(kind.columns)))


def _split(body: bytes, separator: str) -> list[str] | None:
    """The cells of a line; None where it is not a row of separated values."""
    try:
        return next(csv.reader([body.decode()], delimiter=separator, strict=True))
    except (csv.Error, UnicodeDecodeError, StopIteration, TypeError, ValueError):
        return None
