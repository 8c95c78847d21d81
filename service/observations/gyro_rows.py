"""Conversion of CSV rows, with one gyro sample each, to gyro blocks.

The rows of one (spacecraft, run, block) form a block; `CsvTable` keeps them together. The rows are
converted to the JSON of an NDJSON file, so that the same checks apply.
"""

from collections.abc import Mapping
from typing import Any

from service.errors import BadFile, BadInput, Fault
from service.observations import csv_rows
from service.observations.csv_table import CsvRow, RowKind
from service.times import parse_utc

KEY = ("spacecraft", "run", "block")
RATES = ("rate_1_rad_per_s", "rate_2_rad_per_s", "rate_3_rad_per_s")
REQUIRED = ("spacecraft", "block", "time", *RATES)
GYRO_COLUMNS = (*KEY, "time", *RATES)
MAX_ROWS = 10_000


class BlockRows(csv_rows.JoinedRows):
    """A collector for the CSV rows of one gyro block, with one sample per row."""

    key_columns = KEY
    may_lack = "the block may lack a sample"
    refuses_faulty_rows = False

    def __init__(self, number: int, key: tuple[str, ...]) -> None:
        super().__init__(number, key)
        self.start, self.start_ns = "", 0
        self.times_s: list[float] = []
        self.rates: list[list[float]] = []
        self._taken: set[tuple[float, ...]] = set()

    def take(self, row: CsvRow) -> None:
        """Read the cells of one CSV row of a gyro block; raises `BadCell`."""
        try:
            time = parse_utc(row["time"])
        except BadInput as error:
            raise csv_rows.BadCell("time", error.faults[0].message, row["time"]) from None
        if not self.rates:
            self.start, self.start_ns = time.text, time.tai_ns
        time_s = (time.tai_ns - self.start_ns) * 1e-9
        rates = [csv_rows.number_cell(row, column) for column in RATES]
        if (row_of := (time_s, *rates)) in self._taken:
            # A repeated row: the row was written twice, or a file appended to itself.
            return
        if len(self.rates) == MAX_ROWS:
            raise csv_rows.BadCell("block", f"has more than {MAX_ROWS} rows", self.key[-1])
        self._taken.add(row_of)
        self.times_s.append(time_s)
        self.rates.append(rates)

    def body(self) -> Mapping[str, Any]:
        """The JSON object of the gyro block made from all collected rows."""
        named = {name: value for name, value in zip(KEY, self.key, strict=True) if value}
        times = {"start": self.start, "times_s": self.times_s}
        return {**named, **times, "rates_rad_per_s": self.rates}


def _check_header(names: list[str], where: str) -> None:
    """Raise `BadFile` for a CSV column that is unknown, missing or repeated."""
    there_are = f"there is no such column; there are {', '.join(GYRO_COLUMNS)}"
    faults = [
        Fault(f"{where}, column {name or '(empty)'}", there_are)
        for name in names
        if name not in GYRO_COLUMNS
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
    GYRO_COLUMNS,
    texts=frozenset((*KEY, "time")),
    verbatim=frozenset(),
    check_header=_check_header,
    ordered_by_time=True,
)
