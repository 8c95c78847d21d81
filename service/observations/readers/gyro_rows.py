"""Gyro blocks as rows of comma-separated values, one sample a row.

The rows of one (spacecraft, run, block) form a block; `CsvTable` gives them together.  What the
rows give is the same JSON as that of an NDJSON file, so that the same checks hold for it.
"""

import json
from collections.abc import Iterator
from typing import Any

from service.errors import BadFile, BadInput, Fault
from service.observations.readers.csv_columns import BadCell, number_cell
from service.observations.readers.csv_table import CsvRow, Row, RowKind
from service.observations.readers.decompress import Line
from service.times import parse_utc

KEY = ("spacecraft", "run", "block")
RATES = ("rate_1_rad_per_s", "rate_2_rad_per_s", "rate_3_rad_per_s")
REQUIRED = ("spacecraft", "block", "time", *RATES)
COLUMNS = (*KEY, "time", *RATES)
MAX_ROWS = 10_000


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


def blocks_of_rows(rows: Iterator[Row]) -> Iterator[Line]:
    """The blocks of the rows of a CSV file.

    A block with a bad cell is refused whole, by the line and column of the first such cell.  A
    damaged row refuses the blocks on both sides of it: one of them lacks a sample.
    """
    block: _BlockRows | None = None
    stray: int | None = None
    for row in rows:
        if row.cells is None or row.fault is not None:
            if block is not None:
                block.refuse(row.number, _beside(block.number, row.number))
                yield block.line()
            yield Line(row.number, None, row.fault)
            block, stray = None, row.number
            continue
        key = tuple(row.cells.get(column, "") for column in KEY)
        if block is None or key != block.key:
            if block is not None:
                yield block.line()
            fault = None if stray is None else _beside(row.number, stray)
            block, stray = _BlockRows(row.number, key, fault), None
        block.add(row.number, row.cells)
    if block is not None:
        yield block.line()


def _check_header(names: list[str], where: str) -> None:
    """Raise `BadFile` for a column that is unknown, missing or there twice."""
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


GYRO_ROWS = RowKind(
    "block",
    KEY,
    COLUMNS,
    texts=frozenset((*KEY, "time")),
    verbatim=frozenset(),
    check_header=_check_header,
    ordered_by_time=True,
)


def _beside(block: int, damaged: int) -> Fault:
    message = f"the block may lack a sample: the row beside it, line {damaged}, cannot be read"
    return Fault(f"line {block}", message)
