"""A reader of CSV files: separator, header and decimal mark, and rows grouped by batch.

Spreadsheets write commas, semicolons or tabs between cells, perhaps a line `sep=;` before the
header, and in some languages decimal commas. A first pass over the file finds out whether the rows
of one batch are scattered, as in a file sorted by magnitude or by tracker. Scattered rows are then
grouped, with the batches in order of time.
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

# The line sums of a raster fill one cell, which exceeds the csv module's default limit.
csv.field_size_limit(MAX_LINE_BYTES)

SEPARATORS = (",", ";", "\t", "|")
MOST_GROUPS = 8_000_000
"""Largest number of groups of consecutive rows of one batch in a file; each takes 16 bytes."""
MOST_ROWS_APART = 4_000_000
"""Largest number of rows in a file with scattered batches; each takes 32 bytes."""

_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?[,;\t|]*', re.IGNORECASE)

CsvRow = dict[str, str]


@dataclass(frozen=True)
class RowKind:
    """A kind of CSV file: its columns, and those that identify a batch or block."""

    noun: str
    key: tuple[str, str, str]
    """The columns that identify a batch or block: spacecraft, run (may be empty) and name."""
    columns: Sequence[str]
    texts: frozenset[str]
    """Columns that hold text instead of numbers."""
    verbatim: frozenset[str]
    """Columns whose cells keep their spaces; other cells are stripped."""
    check_header: Callable[[list[str], str], None]
    """A function that raises `BadFile` for wrong column names, given their location in the file."""
    ordered_by_time: bool
    """True if scattered rows of one batch or block are sorted by time."""


@dataclass(frozen=True)
class Row:
    """A CSV row as cells by column; `cells` is None if the row cannot be assigned to a batch."""

    number: int
    cells: CsvRow | None
    fault: Fault | None = None


@dataclass(frozen=True)
class _Place:
    """Location of a CSV row: the byte offset where the row before it ends, and its line number."""

    offset: int
    number: int


class CsvTable:
    """A CSV file as rows by column; `kind` is the kind of file recognised by its header."""

    def __init__(self, stream: BinaryIO, kinds: Sequence[RowKind]) -> None:
        """Scan a whole seekable CSV file once, for header, decimal mark and scattered rows.

        Raises `BadFile` for the header, for decimal commas beside decimal points, and for scattered
        rows that cannot be grouped by batch.
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
        """The rows of the file, those of one batch together; to be called once."""
        for line in self._lines() if self._places is None else self._lines_at(self._places):
            if (row := self._row(line)) is not None:
                yield row

    def _header(self, kinds: Sequence[RowKind]) -> list[str]:
        """The column names in a header, after comment lines with `#`; also finds the separator."""
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
        """The lines of a CSV file after its header, in the order of the file."""
        self._stream.seek(self._rows_start)
        return physical_lines(self._stream, self._header_line)

    def _lines_at(self, places: Iterator[_Place]) -> Iterator[Line]:
        for place in places:
            self._stream.seek(place.offset)
            line = next(physical_lines(self._stream, self._header_line))
            yield replace(line, number=place.number)

    def _cells(self, line: Line) -> list[str] | Fault:
        """Cells of a CSV line, none for an empty one or a repeated header; or the line's fault."""
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
        """The key texts of a row's batch; None if they cannot be read."""
        spacecraft, run, name = (
            "" if k is None else found[k] if k < len(found) else None for k in self._key_columns
        )
        return (spacecraft, run, name) if spacecraft and run is not None and name else None

    def _row(self, line: Line) -> Row | None:
        """The CSV row in a line; None for a line without cells and for a repeated header."""
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
                # A leading apostrophe marks a cell, even with a number, as text for a spreadsheet.
                cell = cell.strip().removeprefix("'")
                cells[name] = cell.replace(",", ".") if self._decimal_comma else cell
            else:
                cells[name] = original(cell if name in self.kind.verbatim else cell.strip())
                if name == "time":
                    cells[name] = _with_point(cells[name])
        return Row(line.number, cells, fault)

    def _survey(self) -> int | None:
        """Scan all rows; returns the first line whose batch also occurred earlier, or None."""
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
        # In a file separated by commas a number with both marks is refused cell by cell: its comma
        # separates thousands.
        self._decimal_comma = list(marks) == [","]
        _, begun = np.unique(np.array(keys), return_index=True)
        again = np.ones(len(keys), bool)
        again[begun] = False
        return int(firsts[int(np.argmax(again))]) if again.any() else None

    def _together(self, apart: int) -> Iterator[_Place]:
        """The locations of all rows, grouped by batch, with the batches in order of time."""
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
    """Indices that sort rows by their batch's earliest time, batch, own time if asked, place."""
    _, first, batch = np.unique(keys, return_index=True, return_inverse=True)
    earliest = np.full(len(first), np.iinfo(np.int64).max)
    np.minimum.at(earliest, batch, times_ns)
    within = times_ns if ordered_by_time else np.zeros_like(times_ns)
    return np.lexsort((within, first[batch], earliest[batch]))


def _time_ns(text: str) -> int:
    """The time of a CSV row in TAI nanoseconds; 0 for an unreadable one, which is refused later."""
    try:
        return parse_utc(_with_point(text.strip())).tai_ns
    except BadInput:
        return 0


def _with_point(time: str) -> str:
    """An ISO 8601 time with its decimal comma, if any, replaced by a point."""
    return time.replace(",", ".")


def _lower(names: Sequence[str]) -> list[str]:
    return [name.strip().lower() for name in names]


def _kind_of(names: list[str], kinds: Sequence[RowKind]) -> RowKind:
    """The kind of CSV file that shares the most column names with a header."""
    return max(kinds, key=lambda kind: len(set(names) & set(kind.columns)))


def _split(body: bytes, separator: str) -> list[str] | None:
    """The cells of a line of separated values; None if it cannot be parsed."""
    try:
        return next(csv.reader([body.decode()], delimiter=separator, strict=True))
    except (csv.Error, UnicodeDecodeError, StopIteration, TypeError, ValueError):
        return None
