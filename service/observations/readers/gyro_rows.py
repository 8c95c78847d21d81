"""Gyro blocks as rows of comma-separated values, one sample a row.

Consecutive rows of one (spacecraft, run, block) form a block.  What the rows give is the same
JSON as that of an NDJSON file, so that the same checks hold for it.
"""

import json
from collections.abc import Iterator
from typing import Any

from service.errors import BadFile, BadInput, Fault
from service.observations.readers.csv_columns import BadCell, CsvRow, number_cell
from service.observations.readers.csv_split import split_row
from service.observations.readers.lines import Line
from service.times import parse_utc

KEY = ("spacecraft", "run", "block")
RATES = ("rate_1_rad_per_s", "rate_2_rad_per_s", "rate_3_rad_per_s")
REQUIRED = ("spacecraft", "block", "time", *RATES)
COLUMNS = (*KEY, "time", *RATES)
MAX_ROWS = 10_000


def is_gyro_header(line: Line | None) -> bool:
    """Whether the first line of a CSV file is the header of gyro samples."""
    names = None if line is None or line.body is None else split_row(line.body)
    return names is not None and any(name.strip() in RATES for name in names)


class _BlockRows:
    """The rows of one block as they come in."""

    def __init__(self, number: int, key: tuple[str, ...], fault: Fault | None = None) -> None:
        self.number, self.key, self.fault = number, key, fault
        self.fault_at = number
        self.start, self.start_ns = "", 0
        self.times_s: list[float] = []
        self.rates: list[list[float]] = []

    def add(self, number: int, row: CsvRow) -> None:
        if self.fault is not None:
            return
        try:
            if len(self.rates) == MAX_ROWS:
                raise BadCell("block", f"has more than {MAX_ROWS} rows", self.key[-1])
            try:
                time = parse_utc(row["time"])
            except BadInput as error:
                raise BadCell("time", error.faults[0].message, row["time"]) from None
            if not self.rates:
                self.start, self.start_ns = time.text, time.tai_ns
            self.times_s.append((time.tai_ns - self.start_ns) * 1e-9)
            self.rates.append([number_cell(row, column) for column in RATES])
        except BadCell as bad:
            self.refuse(number, bad.fault(number))

    def refuse(self, number: int, fault: Fault) -> None:
        if self.fault is None:
            self.fault, self.fault_at = fault, number

    def line(self) -> Line:
        if self.fault is not None:
            return Line(self.fault_at, None, self.fault)
        named = {name: value for name, value in zip(KEY, self.key, strict=True) if value}
        body: dict[str, Any] = {**named, "start": self.start, "times_s": self.times_s}
        body["rates_rad_per_s"] = self.rates
        return Line(self.number, json.dumps(body, separators=(",", ":")).encode())


def blocks_of_rows(lines: Iterator[Line]) -> Iterator[Line]:
    """The blocks of a CSV file, given its lines, the header first.

    A block with a bad cell is refused whole, by the line and column of the first such cell.  A
    row too damaged to tell whose it is refuses the blocks on both sides of it: one of them
    lacks a sample.  Raises `BadFile` for the header.
    """
    header = _header(next(lines))
    block: _BlockRows | None = None
    stray: int | None = None
    for line in lines:
        cells = None if line.body is None else split_row(line.body)
        if cells is None or len(cells) != len(header):
            beside = Fault(f"line {line.number}", "is not a row like the header", None)
            if block is not None:
                block.refuse(line.number, _beside(block.number, line.number))
                yield block.line()
            yield Line(line.number, None, line.fault or beside)
            block, stray = None, line.number
            continue
        row = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
        key = tuple(row.get(column, "") for column in KEY)
        if block is None or key != block.key:
            if block is not None:
                yield block.line()
            fault = None if stray is None else _beside(line.number, stray)
            block, stray = _BlockRows(line.number, key, fault), None
        block.add(line.number, row)
    if block is not None:
        yield block.line()


def _header(line: Line) -> list[str]:
    names = [name.strip() for name in split_row(line.body or b"") or ()]
    where = f"line {line.number}"
    there_are = f"there is no such column; there are {', '.join(COLUMNS)}"
    faults = [
        Fault(f"{where}, column {name or '(empty)'}", there_are)
        for name in names
        if name not in COLUMNS
    ]
    faults += [
        Fault(f"{where}, column {name}", "occurs twice")
        for name in sorted({name for name in names if names.count(name) > 1})
    ]
    faults += [
        Fault(f"{where}, column {name}", "is missing") for name in REQUIRED if name not in names
    ]
    if faults:
        raise BadFile(faults)
    return names


def _beside(block: int, damaged: int) -> Fault:
    message = f"the block may lack a sample: the row beside it, line {damaged}, cannot be read"
    return Fault(f"line {block}", message)
