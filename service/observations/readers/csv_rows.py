"""Batches as rows of comma-separated values, one star a row, and back.

Consecutive rows of one (spacecraft, run, batch) form a batch; a row whose star
cells are all empty stands for a tracker that saw none.  What the rows give is
the same JSON as that of an NDJSON file, so that the same checks hold for it.
"""

import csv
import json
from collections.abc import Iterable, Iterator
from typing import Any, TextIO

from service.errors import BadFile, Fault, shown_value
from service.observations.batch import MAX_STARS_PER_TRACKER, MAX_TRACKERS
from service.observations.readers.csv_columns import (
    BATCH_COLUMNS,
    COLUMNS,
    DIRECTION,
    KEY,
    STAR_COLUMNS,
    STAR_NUMBERS,
    VERBATIM,
    BadCell,
    CsvRow,
    batch_cells,
    batch_fields,
    checked_header,
    lines_of,
    list_cells,
    number_cells,
    star_of,
)
from service.observations.readers.csv_split import split_row
from service.observations.readers.lines import Line
from service.observations.schema import BatchIn

MAX_ROWS = MAX_STARS_PER_TRACKER * MAX_TRACKERS


class _BatchRows:
    """The rows of one batch as they come in: its own fields once, then a star a row."""

    def __init__(self, number: int, key: tuple[str, ...], fault: Fault | None = None) -> None:
        self.number, self.key, self.fault = number, key, fault
        self.fault_at = number
        self.first: CsvRow = {}
        self.fields: dict[str, Any] = {}
        self.trackers: dict[str, list[dict[str, Any]]] = {}
        self.rasters: dict[str, dict[str, list[float]]] = {}
        self.rows = 0

    def add(self, number: int, row: CsvRow) -> None:
        if self.fault is not None:
            return
        try:
            self.rows += 1
            if self.rows > MAX_ROWS:
                raise BadCell("batch", f"has more than {MAX_ROWS} rows", self.key[-1])
            if self.rows == 1:
                self.first, self.fields = row, batch_fields(row)
            for column in BATCH_COLUMNS:
                if row.get(column, "") != self.first.get(column, ""):
                    message = f"differs from line {self.number}, the first of the batch"
                    raise BadCell(column, message, row[column])
            if "measurement" in self.fields:
                if self.rows > 1:
                    raise BadCell("batch", "has a second measured attitude", self.key[-1])
                if cell := next((row[each] for each in STAR_COLUMNS[1:] if row.get(each)), None):
                    raise BadCell("batch", "has stars beside a measured attitude", cell)
                return
            stars = self.trackers.setdefault(row["tracker"], [])
            if any(row.get(column) for column in STAR_COLUMNS[1:]):
                stars.append(star_of(row))
            if lines := lines_of(row):
                if row["tracker"] in self.rasters:
                    raise BadCell(next(iter(lines)), "has lines of the tracker a second time")
                self.rasters[row["tracker"]] = lines
        except BadCell as bad:
            self.refuse(number, bad.fault(number))

    def refuse(self, number: int, fault: Fault) -> None:
        if self.fault is None:
            self.fault, self.fault_at = fault, number

    def line(self) -> Line:
        if self.fault is not None:
            return Line(self.fault_at, None, self.fault)
        observations = [
            {"tracker": name, "stars": stars, **self.rasters.get(name, {})}
            for name, stars in self.trackers.items()
        ]
        body = {**self.fields, "observations": observations} if observations else self.fields
        return Line(self.number, json.dumps(body, separators=(",", ":")).encode())


def batches_of_rows(lines: Iterator[Line]) -> Iterator[Line]:
    """The batches of a CSV file, given its lines, the header first.

    A batch with a bad cell is refused whole, by the line and column of the
    first such cell.  A row too damaged to tell whose it is refuses the batches
    on both sides of it: one of them lacks a star.  Raises `BadFile` for the
    header.
    """
    header = _header(next(lines, None))
    batch: _BatchRows | None = None
    stray: int | None = None
    for line in lines:
        cells, fault = _cells(line, header)
        if cells is None:
            if batch is not None:
                batch.refuse(line.number, _beside(batch.number, line.number))
                yield batch.line()
            yield Line(line.number, None, fault)
            batch, stray = None, line.number
            continue
        key = tuple(cells.get(column, "") for column in KEY)
        if batch is None or key != batch.key:
            if batch is not None:
                yield batch.line()
            beside = None if stray is None else _beside(line.number, stray)
            batch, stray = _BatchRows(line.number, key, beside), None
        if fault is not None:
            batch.refuse(line.number, fault)
        batch.add(line.number, cells)
    if batch is not None:
        yield batch.line()


def _header(line: Line | None) -> list[str]:
    if line is None or line.body is None:
        raise BadFile(line.fault if line and line.fault else Fault("line 1", "there is no header"))
    where = f"line {line.number}"
    names = split_row(line.body)
    if names is None:
        raise BadFile(
            Fault(where, "is not a row of comma-separated values", shown_value(line.body))
        )
    names = [name.strip() for name in names]
    checked_header(names, where)
    return names


def _cells(line: Line, header: list[str]) -> tuple[CsvRow | None, Fault | None]:
    """The cells of a row by column, None where it cannot be told whose they are."""
    if line.body is None:
        return None, line.fault
    cells = split_row(line.body)
    if cells is None:
        shown = shown_value(line.body)
        return None, Fault(f"line {line.number}", "is not a row of comma-separated values", shown)
    fault = None
    if len(cells) != len(header):
        message = f"has {len(cells)} cells; the header has {len(header)}"
        fault = Fault(f"line {line.number}", message)
    row = {
        name: cell if name in VERBATIM else cell.strip()
        for name, cell in zip(header, cells, strict=False)
    }
    if any(name in header and name not in row for name in KEY):
        return None, fault
    return row, fault


def _beside(batch: int, damaged: int) -> Fault:
    message = f"the batch may lack a star: the row beside it, line {damaged}, cannot be read"
    return Fault(f"line {batch}", message)


def write_batches_csv(batches: Iterable[BatchIn], stream: TextIO) -> None:
    """Write checked batches as rows; `stream` is opened with `newline=""`.

    A Sun vector or position inside an a priori attitude is written as the
    batch's own, which means the same.
    """
    writer = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for batch in batches:
        common = batch_cells(batch)
        if batch.measurement is not None:
            writer.writerow(common)
        for tracker in batch.observations:
            here = {**common, "tracker": tracker.tracker}
            if not tracker.stars:
                writer.writerow({**here, **list_cells(tracker)})
            for star in tracker.stars:
                numbers = star.model_dump(exclude_none=True, include={*STAR_NUMBERS})
                direction = zip(DIRECTION, star.vector or (), strict=False)
                cells = {**number_cells(direction), **number_cells(numbers.items())}
                writer.writerow({**here, **cells, **list_cells(star)})
