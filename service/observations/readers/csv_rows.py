"""Batches as rows of comma-separated values, one star a row, and back.

The rows of one (spacecraft, run, batch) form a batch; `CsvTable` gives them together.  A row
whose star cells are all empty stands for a tracker that saw none.  What the rows give is
the same JSON as that of an NDJSON file, so that the same checks hold for it.
"""

import csv
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, TextIO

from service.csv_cells import neutralised
from service.errors import Fault
from service.observations.batch import MAX_STARS_PER_TRACKER, MAX_TRACKERS
from service.observations.readers import csv_columns
from service.observations.readers.csv_table import CsvRow, Row, RowKind
from service.observations.readers.decompress import Line
from service.observations.schema import BatchIn

MAX_ROWS = MAX_STARS_PER_TRACKER * MAX_TRACKERS
BATCH_ROWS = RowKind(
    "batch",
    csv_columns.KEY,
    csv_columns.COLUMNS,
    texts=frozenset((*csv_columns.TEXTS, "tracker", "options", "sun_pointed", "a_priori_from")),
    verbatim=frozenset(csv_columns.VERBATIM),
    check_header=csv_columns.checked_header,
    ordered_by_time=False,
)


class JoinedRows(ABC):
    """The rows of one batch or gyro block as they come in; a bad cell refuses all of them."""

    key_columns: ClassVar[tuple[str, ...]]
    """The columns that these rows have in common."""
    may_lack: ClassVar[str]
    """The rows that may be missing where a row beside these cannot be read."""
    refuses_faulty_rows: ClassVar[bool]
    """True if a faulty row refuses the rows of its key alone; False: those beside it, too."""

    def __init__(self, number: int, key: tuple[str, ...]) -> None:
        self.number, self.key = number, key
        self.fault: Fault | None = None
        self.fault_at = number

    def add(self, number: int, row: CsvRow) -> None:
        """Take a row with its number in the file."""
        if self.fault is None:
            try:
                self.take(row)
            except csv_columns.BadCell as bad:
                self.refuse(number, bad.fault(number))

    @abstractmethod
    def take(self, row: CsvRow) -> None:
        """Take the cells of a row; raises `BadCell`."""

    @abstractmethod
    def body(self) -> Mapping[str, Any]:
        """The JSON object of all rows."""

    def refuse(self, number: int, fault: Fault) -> None:
        """Refuse all rows for a fault, unless they are refused already."""
        if self.fault is None:
            self.fault, self.fault_at = fault, number

    def refuse_beside(self, number: int, damaged: int) -> None:
        """Refuse all rows for a damaged one beside them, which may have been one of them."""
        message = f"{self.may_lack}: the row beside it, line {damaged}, cannot be read"
        self.refuse(number, Fault(f"line {self.number}", message))

    def line(self) -> Line:
        """The rows as a line of JSON, or their fault."""
        if self.fault is not None:
            return Line(self.fault_at, None, self.fault)
        return Line(self.number, json.dumps(self.body(), separators=(",", ":")).encode())


def joined_lines(rows: Iterator[Row], kind: type[JoinedRows]) -> Iterator[Line]:
    """The batches or gyro blocks of the rows of a CSV file.

    One with a bad cell is refused whole, by the line and column of the first such cell.  A row
    too damaged to tell whose it is refuses those on both sides of it: one of them lacks a row.
    """
    joined: JoinedRows | None = None
    stray: int | None = None
    for row in rows:
        if row.cells is None or (row.fault is not None and not kind.refuses_faulty_rows):
            if joined is not None:
                joined.refuse_beside(row.number, row.number)
                yield joined.line()
            yield Line(row.number, None, row.fault)
            joined, stray = None, row.number
            continue
        key = tuple(row.cells.get(column, "") for column in kind.key_columns)
        if joined is None or key != joined.key:
            if joined is not None:
                yield joined.line()
            joined = kind(row.number, key)
            if stray is not None:
                joined.refuse_beside(row.number, stray)
            stray = None
        if row.fault is not None:
            joined.refuse(row.number, row.fault)
        joined.add(row.number, row.cells)
    if joined is not None:
        yield joined.line()


class BatchRows(JoinedRows):
    """The rows of one batch: its own fields once, then a star a row."""

    key_columns = csv_columns.KEY
    may_lack = "the batch may lack a star"
    refuses_faulty_rows = True

    def __init__(self, number: int, key: tuple[str, ...]) -> None:
        super().__init__(number, key)
        self.first: CsvRow = {}
        self.fields: dict[str, Any] = {}
        self.trackers: dict[str, list[dict[str, Any]]] = {}
        self.rasters: dict[str, dict[str, list[float]]] = {}
        self.rows = 0

    def take(self, row: CsvRow) -> None:
        """Take the cells of a row; raises `BadCell`."""
        self.rows += 1
        if self.rows > MAX_ROWS:
            raise csv_columns.BadCell("batch", f"has more than {MAX_ROWS} rows", self.key[-1])
        if self.rows == 1:
            self.first, self.fields = row, csv_columns.batch_fields(row)
        for column in csv_columns.BATCH_COLUMNS:
            if row.get(column, "") != self.first.get(column, ""):
                message = f"differs from line {self.number}, the first of the batch"
                raise csv_columns.BadCell(column, message, row[column])
        if "measurement" in self.fields:
            if self.rows > 1:
                raise csv_columns.BadCell("batch", "has a second measured attitude", self.key[-1])
            if cell := next(
                (row[each] for each in csv_columns.STAR_COLUMNS[1:] if row.get(each)), None
            ):
                raise csv_columns.BadCell("batch", "has stars beside a measured attitude", cell)
            return
        stars = self.trackers.setdefault(row["tracker"], [])
        if any(row.get(column) for column in csv_columns.STAR_COLUMNS[1:]):
            stars.append(csv_columns.star_of(row))
        if lines := csv_columns.lines_of(row):
            if row["tracker"] in self.rasters:
                raise csv_columns.BadCell(
                    next(iter(lines)), "has lines of the tracker a second time"
                )
            self.rasters[row["tracker"]] = lines

    def body(self) -> Mapping[str, Any]:
        """The JSON object of the batch."""
        observations = [
            {"tracker": name, "stars": stars, **self.rasters.get(name, {})}
            for name, stars in self.trackers.items()
        ]
        return {**self.fields, "observations": observations} if observations else self.fields


def write_batches_csv(batches: Iterable[BatchIn], stream: TextIO) -> None:
    """Write checked batches as rows; `stream` is opened with `newline=""`.

    A Sun vector or position inside an a priori attitude is written as the
    batch's own, which means the same.
    """
    writer = csv.DictWriter(stream, csv_columns.COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for batch in batches:
        common = _neutralised(csv_columns.batch_cells(batch))
        if batch.measurement is not None:
            writer.writerow(common)
        for tracker in batch.observations:
            tracker_cells = {**common, "tracker": neutralised(tracker.tracker)}
            if not tracker.stars:
                writer.writerow({**tracker_cells, **csv_columns.list_cells(tracker)})
            for star in tracker.stars:
                numbers = star.model_dump(exclude_none=True, include={*csv_columns.STAR_NUMBERS})
                direction = zip(csv_columns.DIRECTION, star.vector or (), strict=False)
                cells = {
                    **csv_columns.number_cells(direction),
                    **csv_columns.number_cells(numbers.items()),
                }
                writer.writerow({**tracker_cells, **cells, **csv_columns.list_cells(star)})


def _neutralised(cells: CsvRow) -> CsvRow:
    """Cells whose texts no spreadsheet takes for formulas."""
    return {
        name: neutralised(cell) if name in csv_columns.VERBATIM else cell
        for name, cell in cells.items()
    }
