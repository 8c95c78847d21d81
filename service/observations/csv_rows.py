"""Conversion of batches to and from rows of comma-separated values, with one star per row.

The rows of one (spacecraft, run, batch) form a batch; `CsvTable` keeps them together. A row without
star cells stands for a tracker without stars. The rows are converted to the JSON of an NDJSON file,
so that the same checks apply.

The columns are named after the fields of the JSON object; an empty cell is an absent field.
"""

import difflib
import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, TextIO

from service.csv_cells import neutralised, quoted
from service.errors import BadFile, Fault, shown_value
from service.observations import schema
from service.observations.batch import MAX_STARS_PER_TRACKER, MAX_TRACKERS
from service.observations.csv_table import CsvRow, Row, RowKind
from service.observations.decompress import Line
from service.observations.schema import BatchIn

KEY = ("spacecraft", "run", "batch")
REQUIRED = ("spacecraft", "batch", "time", "tracker")
TEXTS = ("spacecraft", "batch", "run", "time", "frame", "aberration")
VECTORS = {
    "quaternion": ("q1", "q2", "q3", "qc"),
    "boresight": ("boresight_ra_deg", "boresight_dec_deg"),
    "body_rates_deg_per_s": ("rate_x_deg_per_s", "rate_y_deg_per_s", "rate_z_deg_per_s"),
    "velocity_km_per_s": ("velocity_x_km_per_s", "velocity_y_km_per_s", "velocity_z_km_per_s"),
    "position_km": ("position_x_km", "position_y_km", "position_z_km"),
    "sun_vector": ("sun_vector_x", "sun_vector_y", "sun_vector_z"),
    "measured_quaternion": ("measured_q1", "measured_q2", "measured_q3", "measured_qc"),
    "measured_sigma_arcsec": (
        "measured_sigma_x_arcsec",
        "measured_sigma_y_arcsec",
        "measured_sigma_z_arcsec",
    ),
    "measured_covariance_arcsec2": tuple(
        f"measured_p{each}_arcsec2" for each in ("11", "12", "13", "22", "23", "33")
    ),
}
DIRECTION = ("x", "y", "z")
STAR_NUMBERS = ("h_deg", "v_deg", "magnitude", "time_offset_s", "sigma_arcsec")
READINGS = ("h_counts", "v_counts", "h_times", "v_times")
"""CSV columns with a scanning tracker's readings of a star: numbers separated by spaces."""
LINES = ("column_counts", "row_counts")
"""CSV columns with the line sums of a raster, in a row without a star."""
STAR_COLUMNS = ("tracker", *DIRECTION, *STAR_NUMBERS, *READINGS)
PRIORS = ("sun_pointed", "sun_counts", "a_priori_from")
BATCH_COLUMNS = (*TEXTS, *sum(VECTORS.values(), ()), *PRIORS, "options")
COLUMNS = (*BATCH_COLUMNS, *STAR_COLUMNS, *LINES)
MEASURED = ("measured_quaternion", "measured_sigma_arcsec", "measured_covariance_arcsec2")
"""CSV columns of an attitude measured by a tracker itself, in a row without a star."""
VERBATIM = (*TEXTS, "tracker")
"""CSV columns whose cells keep their spaces; all other cells are stripped."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?", re.ASCII)
_D_TO_E = str.maketrans("dD", "ee")


class BadCell(Exception):
    """An error: a CSV cell cannot be read. It knows the column but not the line."""

    def __init__(self, column: str, message: str, value: object = None) -> None:
        self.column, self.message = column, message
        self.value = None if value is None else shown_value(value)

    def fault(self, line: int) -> Fault:
        """The error of a CSV cell as a fault that names its line and column."""
        return Fault(f"line {line}, column {self.column}", self.message, self.value)


def checked_header(names: list[str], where: str) -> None:
    """Raise `BadFile` for CSV columns that are unknown, missing or repeated."""
    faults = [
        Fault(f"{where}, column {name or '(empty)'}", f"there is no such column; {_near(name)}")
        for name in names
        if name not in COLUMNS
    ]
    faults += [
        Fault(f"{where}, column {name}", "occurs twice")
        for name in sorted({name for name in names if names.count(name) > 1})
    ]
    wanted = list(REQUIRED)
    # The columns of a group must all be present or absent; a star needs a direction.
    groups = *VECTORS.values(), DIRECTION, ("h_deg", "v_deg"), READINGS[:2], READINGS[2:], LINES
    for group in groups:
        wanted += group if any(name in names for name in group) else ()
    if not any(
        name in names
        for name in (*VECTORS["measured_quaternion"], "h_deg", "v_deg", *READINGS[2:], *LINES)
    ):
        wanted += DIRECTION
    faults += [
        Fault(f"{where}, column {name}", "is missing")
        for name in dict.fromkeys(wanted)
        if name not in names
    ]
    if faults:
        raise BadFile(faults)


def _near(name: str) -> str:
    close = difflib.get_close_matches(name, COLUMNS, n=1)
    return f"{close[0]} is meant?" if close else f"there are {', '.join(COLUMNS)}"


def number_cell(row: CsvRow, column: str) -> float:
    """The finite number in a CSV cell; raises `BadCell`."""
    cell = row[column]
    if not cell:
        raise BadCell(column, "is empty, while the columns that belong to it are not")
    return _number(column, cell)


def _number(column: str, cell: str) -> float:
    if not _NUMBER.fullmatch(cell):
        raise BadCell(column, "must be a number", cell)
    # Fortran writes double precision exponents with D.
    number = float(cell.translate(_D_TO_E))
    if not math.isfinite(number):
        raise BadCell(column, "must be a finite number", cell)
    return number


def _group(row: CsvRow, columns: tuple[str, ...]) -> list[float] | None:
    """The numbers of a group of columns that must be filled together; None if all are empty."""
    if not any(row.get(column) for column in columns):
        return None
    return [number_cell(row, column) for column in columns]


def batch_fields(row: CsvRow) -> dict[str, Any]:
    """The fields of a batch other than its stars, from a CSV row; raises `BadCell`."""
    fields: dict[str, Any] = {name: row[name] for name in TEXTS if row.get(name)}
    frame = fields.pop("frame", None)
    values = {name: _group(row, columns) for name, columns in VECTORS.items()}
    quaternion, boresight = values.pop("quaternion"), values.pop("boresight")
    measured = {name: values.pop(name) for name in MEASURED}
    if any(measured.values()):
        fields["measurement"] = _measurement(row, measured, frame)
    fields.update({name: value for name, value in values.items() if value is not None})
    priors: list[dict[str, Any]] = []
    if quaternion is not None:
        priors.append({"quaternion": quaternion})
    if boresight is not None:
        priors.append({"boresight": dict(zip(("ra_deg", "dec_deg"), boresight, strict=True))})
    if sun_pointed := row.get("sun_pointed", ""):
        if sun_pointed.lower() not in ("true", "false", "1", "0"):
            raise BadCell("sun_pointed", "must be true, false or empty", sun_pointed)
        if sun_pointed.lower() in ("true", "1"):
            priors.append({"sun_pointed": True, **_numbers(row, ("sun_counts",))})
    if row.get("sun_counts") and "sun_pointed" not in (priors[-1] if priors else ()):
        raise BadCell("sun_counts", "belongs to sun_pointed, which is not true", row["sun_counts"])
    if source := row.get("a_priori_from", ""):
        if source != "last":
            raise BadCell("a_priori_from", "must be last or empty", source)
        priors.append({"from": source})
    if len(priors) > 1:
        kinds = " and ".join(next(iter(prior)) for prior in priors)
        raise BadCell("batch", f"has more than one a priori attitude: {kinds}", row["batch"])
    prior = priors[0] if priors else None
    if prior is not None and frame is not None and "from" not in prior:
        prior["frame"] = frame
    fields["a_priori"] = prior
    if options := row.get("options"):
        try:
            fields["options"] = json.loads(options)
        except ValueError:
            raise BadCell("options", "must be a JSON object", options) from None
    return fields


def _measurement(
    row: CsvRow, measured: dict[str, list[float] | None], frame: str | None
) -> dict[str, Any]:
    """The fields of a measured attitude; an empty cell `tracker` means the attitude of the body."""
    fields: dict[str, Any] = {
        name.removeprefix("measured_"): value
        for name, value in measured.items()
        if value is not None
    }
    if "covariance_arcsec2" in fields:
        p11, p12, p13, p22, p23, p33 = fields["covariance_arcsec2"]
        fields["covariance_arcsec2"] = [[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]]
    if row["tracker"]:
        fields["tracker"] = row["tracker"]
    if frame is not None:
        fields["frame"] = frame
    return fields


def star_of(row: CsvRow) -> dict[str, Any]:
    """The fields of the star in a CSV row, if it has any; raises `BadCell`."""
    star: dict[str, Any] = {name: number_cell(row, name) for name in STAR_NUMBERS if row.get(name)}
    star |= _numbers(row, READINGS)
    vector = _group(row, DIRECTION)
    return star if vector is None else {"vector": vector, **star}


def lines_of(row: CsvRow) -> dict[str, list[float]]:
    """The line sums of a raster in a CSV row, if it has any; raises `BadCell`."""
    return _numbers(row, LINES)


def _numbers(row: CsvRow, columns: tuple[str, ...]) -> dict[str, list[float]]:
    """The non-empty columns of a row, each a list of numbers separated by spaces."""
    return {
        column: [_number(column, cell) for cell in row[column].split()]
        for column in columns
        if row.get(column)
    }


def number_cells(cells: Iterable[tuple[str, float]]) -> CsvRow:
    """CSV cells by column for numbers, as the shortest text that gives the same number."""
    # repr gives the shortest text that is read back as the same number.
    return {column: repr(value) for column, value in cells}


def list_cells(model: schema.StarIn | schema.TrackerIn | schema.SunPointedIn) -> CsvRow:
    """CSV cells for the readings of a star, of a tracker's raster, or of a Sun tracker."""
    names = *READINGS, *LINES, "sun_counts"
    lists = ((name, getattr(model, name, None)) for name in names)
    return {name: " ".join(map(repr, values)) for name, values in lists if values is not None}


def batch_cells(batch: schema.BatchIn) -> CsvRow:
    """The CSV cells of a checked batch that are equal in all of its rows."""
    prior = batch.a_priori
    cells: CsvRow = {"spacecraft": batch.spacecraft, "batch": batch.batch, "run": batch.run}
    cells |= {"time": batch.time, "aberration": batch.aberration}
    vectors: dict[str, tuple[float, ...] | None] = {
        name: getattr(batch, name, None) for name in VECTORS
    }
    if isinstance(prior, schema.FromLastIn):
        if not prior.by_default:
            cells["a_priori_from"] = prior.from_
    elif prior is not None:
        cells["frame"] = prior.frame
    if isinstance(prior, schema.QuaternionIn):
        vectors["quaternion"] = prior.quaternion
    elif isinstance(prior, schema.BoresightIn):
        vectors["boresight"] = (prior.boresight.ra_deg, prior.boresight.dec_deg)
    elif isinstance(prior, schema.SunPointedIn):
        cells["sun_pointed"] = "true"
        cells |= list_cells(prior)
        vectors["sun_vector"] = prior.sun_vector or batch.sun_vector
        vectors["position_km"] = prior.position_km or batch.position_km
    if (measured := batch.measurement) is not None:
        cells |= {"tracker": measured.tracker or "", "frame": measured.frame}
        vectors["measured_quaternion"] = measured.quaternion
        vectors["measured_sigma_arcsec"] = measured.sigma_arcsec
        if measured.covariance_arcsec2 is not None:
            (p11, p12, p13), (_, p22, p23), (_, _, p33) = measured.covariance_arcsec2
            vectors["measured_covariance_arcsec2"] = (p11, p12, p13, p22, p23, p33)
    for name, columns in VECTORS.items():
        cells |= number_cells(zip(columns, vectors[name] or (), strict=False))
    options = batch.options.model_dump(mode="json", exclude_defaults=True)
    if options:
        cells["options"] = json.dumps(options, separators=(",", ":"))
    return cells


MAX_ROWS = MAX_STARS_PER_TRACKER * MAX_TRACKERS
BATCH_ROWS = RowKind(
    "batch",
    KEY,
    COLUMNS,
    texts=frozenset((*TEXTS, "tracker", "options", "sun_pointed", "a_priori_from")),
    verbatim=frozenset(VERBATIM),
    check_header=checked_header,
    ordered_by_time=False,
)


class JoinedRows(ABC):
    """A collector for the CSV rows of one batch or gyro block; a bad cell refuses all rows."""

    key_columns: ClassVar[tuple[str, ...]]
    """The CSV columns that identify a batch or gyro block."""
    may_lack: ClassVar[str]
    """Text of a fault: what a batch or block may lack next to an unreadable row."""
    refuses_faulty_rows: ClassVar[bool]
    """True if a faulty row refuses only its own batch or block; false if neighbours, too."""

    def __init__(self, number: int, key: tuple[str, ...]) -> None:
        self.number, self.key = number, key
        self.fault: Fault | None = None
        self.fault_at = number

    def add(self, number: int, row: CsvRow) -> None:
        """Add a CSV row with its line number in the file; a bad cell refuses all rows."""
        if self.fault is None:
            try:
                self.take(row)
            except BadCell as bad:
                self.refuse(number, bad.fault(number))

    @abstractmethod
    def take(self, row: CsvRow) -> None:
        """Read the cells of one CSV row of a batch or gyro block; raises `BadCell`."""

    @abstractmethod
    def body(self) -> Mapping[str, Any]:
        """The JSON object of the batch or gyro block made from all collected CSV rows."""

    def refuse(self, number: int, fault: Fault) -> None:
        """Refuse all rows for a fault, unless an earlier fault refused them already."""
        if self.fault is None:
            self.fault, self.fault_at = fault, number

    def refuse_beside(self, number: int, damaged: int) -> None:
        """Refuse all rows because a neighbouring unreadable row may have belonged to them."""
        message = f"{self.may_lack}: the row beside it, line {damaged}, cannot be read"
        self.refuse(number, Fault(f"line {self.number}", message))

    def line(self) -> Line:
        """The collected rows as one line of JSON, or their fault."""
        if self.fault is not None:
            return Line(self.fault_at, None, self.fault)
        return Line(self.number, json.dumps(self.body(), separators=(",", ":")).encode())


def joined_lines(rows: Iterator[Row], kind: type[JoinedRows]) -> Iterator[Line]:
    """Lines of JSON with the batches or gyro blocks in the rows of a CSV file.

    A bad cell refuses its whole batch or block, with the line and column of the first bad cell. A
    row too damaged to be assigned refuses the batches on both sides, since one of them lacks a row.
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
    """A collector for the CSV rows of one batch: its own fields, then one star per row."""

    key_columns = KEY
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
        """Read the cells of one CSV row of a batch; raises `BadCell`."""
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
            if self.rows > 1 and row != self.first:
                raise BadCell("batch", "has a second measured attitude", self.key[-1])
            if self.rows > 1:
                words = f"{self.rows - 1} rows repeat the measured attitude"
                self.fields["remarks"] = [f"repeated_rows: {words}, and were counted once"]
            if cell := next((row[each] for each in STAR_COLUMNS[1:] if row.get(each)), None):
                raise BadCell("batch", "has stars beside a measured attitude", cell)
            return
        stars = self.trackers.setdefault(row["tracker"], [])
        if any(row.get(column) for column in STAR_COLUMNS[1:]):
            stars.append(star_of(row))
        if lines := lines_of(row):
            if (before := self.rasters.get(row["tracker"])) == lines:
                words = f"a row of {row['tracker']} repeats its raster, and was counted once"
                self.fields["remarks"] = [f"repeated_rows: {words}"]
            elif before is not None:
                raise BadCell(next(iter(lines)), "has lines of the tracker a second time")
            self.rasters[row["tracker"]] = lines

    def body(self) -> Mapping[str, Any]:
        """The JSON object of the batch made from all collected rows."""
        observations = [
            {"tracker": name, "stars": stars, **self.rasters.get(name, {})}
            for name, stars in self.trackers.items()
        ]
        return {**self.fields, "observations": observations} if observations else self.fields


def write_batches_csv(batches: Iterable[BatchIn], stream: TextIO) -> None:
    """Write checked batches as CSV rows; `stream` must be opened with `newline=""`.

    A Sun vector or position inside an a priori attitude is written as the
    batch's own, which means the same.
    """

    def write_row(cells: Mapping[str, object]) -> None:
        texts = (quoted(str(cells.get(name, ""))) for name in COLUMNS)
        stream.write(",".join(texts) + "\n")

    write_row(dict(zip(COLUMNS, COLUMNS, strict=True)))
    for batch in batches:
        common = _neutralised(batch_cells(batch))
        if batch.measurement is not None:
            write_row(common)
        for tracker in batch.observations:
            tracker_cells = {**common, "tracker": neutralised(tracker.tracker)}
            if not tracker.stars:
                write_row({**tracker_cells, **list_cells(tracker)})
            for star in tracker.stars:
                numbers = star.model_dump(exclude_none=True, include={*STAR_NUMBERS})
                direction = zip(DIRECTION, star.vector or (), strict=False)
                cells = {
                    **number_cells(direction),
                    **number_cells(numbers.items()),
                }
                write_row({**tracker_cells, **cells, **list_cells(star)})


def _neutralised(cells: CsvRow) -> CsvRow:
    """CSV cells with text escaped so that no spreadsheet takes a cell for a formula."""
    return {name: neutralised(cell) if name in VERBATIM else cell for name, cell in cells.items()}
