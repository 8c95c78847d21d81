"""Series of attitudes in order of time: unbroken intervals, continuous signs, rates.

Quaternions are scalar-last and transform J2000 (EME2000) into body components.  Covariances are of
the small error rotation about the body axes, arcsec^2.  Rates are of the body relative to inertial,
in body axes, deg/s.

Also attitudes as a table, and as JSON whose items are written as they are read.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from service.ephemerides.rows import SAME_MOMENT_NS, AttitudeRows, Integers, Texts
from service.errors import BadBatch, Fault, shown_value
from service.interpolation import QUARTER_TURN_RAD
from service.missions import product_settings
from service.table_files.table import Column, Page, Table, number_texts, rows_of_texts
from service.vectors import Vector, rotation_vectors

StatusWanted = Literal["good", "suspect", "all"]
ProductGrade = Literal["raw", "filtered", "smoothed"]
OWN, DERIVED, NONE, ESTIMATED = "own", "derived", "none", "estimated"


@dataclass(frozen=True)
class SeriesTracker:
    """A tracker of the spacecraft: its rotation from tracker to body axes, and its noise."""

    name: str
    body_from_tracker: tuple[tuple[float, ...], ...]
    sigma_arcsec: float


@dataclass(frozen=True)
class SeriesInfo:
    """Metadata of a series of attitudes: spacecraft, run, period, filters and identifiers.

    The grade `raw` has the attitudes of batches; `service.attitude.definitive` has the others.
    `start` and `end` are UTC as text, None if the period is open.  `sclk_kernel` is the
    spacecraft's clock; without it, C-kernels get a clock defined by this service.
    """

    spacecraft: str
    run: str
    created: str
    version: str
    start: str | None = None
    end: str | None = None
    status: StatusWanted = "good"
    grade: ProductGrade = "raw"
    newest_first: bool = False
    largest_gap_s: float = product_settings.DEFAULT_LARGEST_GAP_S
    object_id: str | None = None
    naif_id: int = product_settings.DEFAULT_NAIF_ID
    sclk_kernel: Path | None = None
    trackers: tuple[SeriesTracker, ...] = ()
    record_head: str = ""
    """Number, SHA-256 and time of the record's last head; empty if there is none."""

    def __post_init__(self) -> None:
        """Raise `BadBatch` with the name and value of each field out of range."""
        faults = [
            Fault(name, expected, shown_value(getattr(self, name)))
            for name, is_good, expected in (
                (
                    "largest_gap_s",
                    0 < self.largest_gap_s <= product_settings.MAX_LARGEST_GAP_S,
                    f"must be above 0 and at most {product_settings.MAX_LARGEST_GAP_S:g}",
                ),
                (
                    "naif_id",
                    product_settings.MIN_NAIF_ID <= self.naif_id < 0,
                    f"must be from {product_settings.MIN_NAIF_ID} to -1",
                ),
                (
                    "object_id",
                    self.object_id is None
                    or re.fullmatch(product_settings.OBJECT_ID, self.object_id),
                    f"must match {product_settings.OBJECT_ID}",
                ),
            )
            if not is_good
        ]
        if faults:
            raise BadBatch(faults)

    def described(self) -> str:
        """Description of the series, for a message."""
        words = "attitudes" if self.status == "all" else f"{self.status} attitudes"
        if self.grade != "raw":
            words = words.replace("attitudes", f"{self.grade} attitudes")
        period = "".join(
            f" {word} {moment}"
            for word, moment in (("from", self.start), ("to before", self.end))
            if moment
        )
        return f"{words} of {self.spacecraft} in run {self.run}{period}"

    def provenance(self) -> dict[str, str]:
        """Metadata of the series as texts by name, written into files."""
        return {
            "spacecraft": self.spacecraft,
            "object_id": self.object_id or self.spacecraft,
            "run": self.run,
            "status": self.status,
            "grade": self.grade,
            "start": self.start or "",
            "end": self.end or "",
            "largest_gap_s": repr(self.largest_gap_s),
            "created": self.created,
            "originator": f"attitude-acquisition {self.version}",
            "frame": "EME2000 to spacecraft body; quaternion scalar last",
            "record_head": self.record_head,
        }


@dataclass(frozen=True)
class AttitudeBlock(AttitudeRows):
    """Attitudes of a series with the numbers of their unbroken intervals, counted from 0.

    Within an interval the quaternions have continuous signs.  `rate_origin` is `own` for a batch's
    rate, `derived` from the attitudes before and after, `estimated` by a filter, or `none`.  `gaps`
    counts the batches without a wanted attitude up to each row.
    """

    stretch: Integers
    rate_origin: Texts
    gaps: Integers


@dataclass(frozen=True)
class AttitudeSeries:
    """A series of attitudes in order of time, read block by block."""

    about: SeriesInfo
    blocks: Iterable[AttitudeBlock]


def series_of(about: SeriesInfo, pages: Iterable[AttitudeRows]) -> AttitudeSeries:
    """Build a series from recorded rows in order of time; see `AttitudeBlock`.

    An interval ends if two attitudes are farther apart than the largest gap, if a batch between
    them has no attitude of the wanted status, or if the body makes more than a quarter turn: other
    programs would interpolate along the shorter way.
    """
    return AttitudeSeries(about, _blocks(about, pages))


def stretches(series: AttitudeSeries) -> Iterator[Iterator[AttitudeBlock]]:
    """Unbroken intervals of a series, each in parts that must be read in order."""
    for _, parts in groupby(_parts(series.blocks), key=lambda part: int(part.stretch[0])):
        yield parts


def _parts(blocks: Iterable[AttitudeBlock]) -> Iterator[AttitudeBlock]:
    for block in blocks:
        begins = np.flatnonzero(np.diff(block.stretch)) + 1
        edges = [0, *begins.tolist(), len(block)]
        for first, end in pairwise(edges):
            yield block.taken(slice(first, end))


def _blocks(about: SeriesInfo, pages: Iterable[AttitudeRows]) -> Iterator[AttitudeBlock]:
    assembler = _Assembler(about)
    for page in pages:
        if len(block := assembler.fed(page)):
            yield block
    if (rest := assembler.rest()) is not None:
        yield rest


class _Assembler:
    """Computes rates, signs and interval numbers of attitudes that arrive page by page.

    Two rows wait: the last may still be replaced by one of the same moment, and the rate of the one
    before depends on it.
    """

    def __init__(self, about: SeriesInfo) -> None:
        self._about = about
        self._wanted = ("good", "suspect") if about.status == "all" else (about.status,)
        self._unwanted = 0
        self._held: AttitudeBlock | None = None
        self._emitted = 0

    def fed(self, page: AttitudeRows) -> AttitudeBlock:
        """Add a page of attitudes; returns the rows that are complete now, perhaps none."""
        is_wanted = _among(page.status, self._wanted)
        gaps = self._unwanted + np.cumsum(~is_wanted)
        self._unwanted = int(gaps[-1]) if len(gaps) else self._unwanted
        origin = OWN if self._about.grade == "raw" else ESTIMATED
        new = _unfinished(page.taken(is_wanted), gaps[is_wanted], origin)
        rows = new if self._held is None else self._held.followed_by(new)
        return self._finished(rows, waiting=2)

    def rest(self) -> AttitudeBlock | None:
        """Rows that still wait after the last page of attitudes; None if there are none."""
        if self._held is None or len(self._held) == self._emitted:
            return None
        return self._finished(self._held, waiting=0)

    def _finished(self, rows: AttitudeBlock, waiting: int) -> AttitudeBlock:
        rows = self._without_repeats(rows)
        emitted = self._emitted
        first = rows.stretch[0] if emitted else 0
        rows = _with_stretches(rows, self._about.largest_gap_s, first)
        end = max(emitted, len(rows) - waiting)
        finished = _with_rates(rows).taken(slice(emitted, end))
        # The last emitted row is kept for the rate and the sign of the next.
        self._emitted = min(end, 1)
        self._held = rows.taken(slice(end - self._emitted, None))
        return finished

    def _without_repeats(self, rows: AttitudeBlock) -> AttitudeBlock:
        close = np.abs(np.diff(rows.time_ns)) < SAME_MOMENT_NS
        dropped = np.zeros(len(rows), dtype=bool)
        if self._about.newest_first:
            dropped[1:] = close
        else:
            dropped[:-1] = close
        dropped[: self._emitted] = False
        return rows.taken(~dropped) if dropped.any() else rows


def _among(texts: Texts, wanted: Sequence[str]) -> npt.NDArray[np.bool_]:
    """Mask of texts that equal one of `wanted`; `numpy.isin` needs texts of fixed width."""
    return np.asarray(np.logical_or.reduce([texts == each for each in wanted]))


def _unfinished(rows: AttitudeRows, gaps: Integers, known: str) -> AttitudeBlock:
    n = len(rows)
    origin = np.where(np.isnan(rows.rate_deg_per_s[:, 0]), NONE, known).astype(object)
    own = {f.name: getattr(rows, f.name) for f in fields(AttitudeRows)}
    return AttitudeBlock(**own, stretch=np.zeros(n, np.int64), rate_origin=origin, gaps=gaps)


def follows(rows: AttitudeBlock, largest_gap_s: float) -> npt.NDArray[np.bool_]:
    """Mask (n - 1,) of rows that follow the previous one within the gap, with no batch missing."""
    near = np.abs(np.diff(rows.time_ns)) <= round(largest_gap_s * 1e9)
    return np.asarray(near & (np.diff(rows.gaps) == 0))


def known_rates(rows: AttitudeBlock) -> Vector:
    """Rates (n, 3) in deg/s from batches or a filter; NaN where unknown or derived."""
    is_known = _among(rows.rate_origin, (OWN, ESTIMATED))
    return np.where(is_known[:, None], rows.rate_deg_per_s, np.nan)


def turns_far(rows: AttitudeBlock) -> npt.NDArray[np.bool_]:
    """Mask (n - 1,) of steps of more than a quarter turn, by attitudes or by rates."""
    step_s = np.abs(np.diff(rows.time_ns)) * 1e-9
    turn = np.linalg.norm(rotation_vectors(rows.quaternion[:-1], rows.quaternion[1:]), axis=1)
    rate = np.nan_to_num(np.linalg.norm(np.radians(known_rates(rows)), axis=1))
    at_rates = np.maximum(rate[:-1], rate[1:]) * step_s
    return np.asarray((turn > QUARTER_TURN_RAD) | (at_rates > QUARTER_TURN_RAD))


def _with_stretches(rows: AttitudeBlock, largest_gap_s: float, first: int) -> AttitudeBlock:
    """Number the unbroken intervals of rows from `first`, and make quaternion signs continuous."""
    if not len(rows):
        return rows
    begins = ~follows(rows, largest_gap_s) | turns_far(rows)
    stretch = first + np.concatenate([[0], np.cumsum(begins)])
    along = np.sum(rows.quaternion[1:] * rows.quaternion[:-1], axis=1)
    turned = np.where((along < 0) & ~begins, -1.0, 1.0)
    sign = np.cumprod(np.concatenate([[1.0], turned]))
    # Each stretch keeps the sign of its own first attitude.
    begin = np.maximum.accumulate(
        np.where(np.concatenate([[True], begins]), np.arange(len(sign)), 0)
    )
    sign *= sign[begin]
    return replace(rows, stretch=stretch, quaternion=rows.quaternion * sign[:, None])


def _with_rates(rows: AttitudeBlock) -> AttitudeBlock:
    """Derive missing rates from neighbouring attitudes.

    The rate is interpolated linearly between the steps before and after a row; at the ends of an
    interval it is the rate of the one step.  A lone attitude has none.
    """
    if len(rows) < 2 or not np.any(_among(rows.rate_origin, (NONE, DERIVED))):
        return rows
    step_s = np.diff(rows.time_ns) * 1e-9
    joined = np.diff(rows.stretch) == 0
    turn = rotation_vectors(rows.quaternion[:-1], rows.quaternion[1:])
    rate = np.full_like(turn, np.nan)
    rate[joined] = np.degrees(turn[joined]) / step_s[joined, None]
    none = np.full((1, 3), np.nan)
    before, after = np.concatenate([none, rate]), np.concatenate([rate, none])
    width = np.abs(np.concatenate([[0.0], step_s, [0.0]]))[:, None]
    between = (before * width[1:] + after * width[:-1]) / (width[1:] + width[:-1])
    derived = np.where(np.isnan(before), after, np.where(np.isnan(after), before, between))
    missing = rows.rate_origin == NONE
    missing &= ~np.isnan(derived[:, 0])
    result = np.where(missing[:, None], derived, rows.rate_deg_per_s)
    origin = np.where(missing, DERIVED, rows.rate_origin)
    return replace(rows, rate_deg_per_s=result, rate_origin=origin)


_BODY, _INERTIAL = "SC_BODY_1", "EME2000"
_TO_BODY = f"{_INERTIAL} to {_BODY}"
_COVARIANCE = ("11", "12", "13", "22", "23", "33")

COLUMNS = (
    Column("time", "utc", description="UTC. Time of the batch.", width=30),
    Column("tai_ns", "integer", "ns", description="TAI since 2000-01-01T12:00:00 TAI."),
    *(
        Column(
            f"q{part}",
            frame=_TO_BODY,
            description="Component of the quaternion, scalar (qc) last; signs are continuous "
            "within a stretch.",
        )
        for part in ("1", "2", "3", "c")
    ),
    *(
        Column(
            f"p{part}",
            unit="arcsec^2",
            frame=_BODY,
            description="Covariance of the small error rotation about the body axes.",
        )
        for part in _COVARIANCE
    ),
    *(
        Column(
            f"rate_{axis}",
            unit="deg/s",
            frame=_BODY,
            description="Rate of the body relative to inertial.",
        )
        for axis in "xyz"
    ),
    Column(
        "rate_origin",
        "text",
        description="own: of the batch; derived: from the attitudes before and after; none.",
        width=8,
    ),
    Column("status", "text", description="good or suspect.", width=8),
    Column("method", "text", description="quest or triad.", width=8),
    Column("residual_rms_arcsec", unit="arcsec", description="Residuals of the stars, rms."),
    Column("predicted_rms_arcsec", unit="arcsec", description="The same as expected."),
    Column("stretch", "integer", description="Number of the unbroken stretch, from 0."),
    Column("batch", "text", description="Name of the batch.", width=128),
    Column("id", "text", description="Id of the result.", width=26),
)
"""Columns of the table of raw attitudes."""

_OF_BATCHES = ("rate_origin", "residual_rms_arcsec", "predicted_rms_arcsec", "batch")
_OF_ESTIMATES: dict[str, dict[str, Any]] = {
    "time": {"description": "Time of the sample."},
    "method": {"description": "ekf or filter_smoother.", "width": 16},
    "id": {"description": "Id of the revision of the day."},
}
ESTIMATED_COLUMNS = (
    *(
        replace(each, **_OF_ESTIMATES.get(each.name, {}))
        for each in COLUMNS
        if each.name not in _OF_BATCHES
    ),
    *(
        Column(f"bias_{axis}", unit="deg/h", frame=_BODY, description="Bias of the gyro.")
        for axis in "xyz"
    ),
    *(
        Column(
            f"bias_sigma_{axis}",
            unit="deg/h",
            frame=_BODY,
            description="One sigma of the bias or, at a constant rate, of the rate.",
        )
        for axis in "xyz"
    ),
    Column("model", "text", description="gyro or constant_rate.", width=16),
    Column("revision", "integer", description="Of the day, from 1."),
)
"""Columns of the table of filtered and smoothed attitudes."""


def attitude_table(series: AttitudeSeries) -> Table:
    """Table of a series, with one attitude per row."""
    columns = COLUMNS if series.about.grade == "raw" else ESTIMATED_COLUMNS
    about = {"product": "attitude", **series.about.provenance()}
    return Table(columns, _pages(series, [each.name for each in columns]), about)


def _pages(series: AttitudeSeries, names: Sequence[str]) -> Iterator[Page]:
    for block in series.blocks:
        values = page_of(block)
        yield [values[name] for name in names]


def page_of(block: AttitudeBlock) -> dict[str, list[Any]]:
    """Values of all table columns by name, as plain values; None where unknown."""
    parts = {
        "q": (("1", "2", "3", "c"), block.quaternion),
        "p": (_COVARIANCE, block.covariance_arcsec2),
        "rate_": ("xyz", block.rate_deg_per_s),
        "bias_": ("xyz", block.bias_deg_per_h),
        "bias_sigma_": ("xyz", block.bias_sigma_deg_per_h),
    }
    found: dict[str, list[Any]] = {
        f"{name}{part}": column
        for name, (each, values) in parts.items()
        for part, column in zip(each, _columns(values), strict=True)
    }
    plain = (
        *("time", "rate_origin", "status", "method", "residual_rms_arcsec"),
        *("predicted_rms_arcsec", "stretch", "batch", "id", "model", "revision"),
    )
    found |= {name: getattr(block, name).tolist() for name in plain}
    return found | {"tai_ns": block.time_ns.tolist()}


def _columns(values: Vector) -> list[list[Any]]:
    columns: list[list[Any]] = values.T.tolist()
    if np.isnan(values).any():
        columns = [[None if each != each else each for each in column] for column in columns]
    return columns


_ENCODER = msgspec.json.Encoder()


def write_json(series: AttitudeSeries) -> Iterator[bytes]:
    """Write a series as JSON: `about` with metadata, and `items` with an object per attitude."""
    yield b'{"about":' + _ENCODER.encode(series.about.provenance()) + b',"items":['
    is_first = True
    for block in series.blocks:
        text = ",".join(_items(block)).encode()
        yield text if is_first else b"," + text
        is_first = False
    yield b"]}"


def _items(block: AttitudeBlock) -> Iterator[str]:
    """JSON objects of the attitudes in a block with at least one.

    They are assembled from texts: encoding plain objects takes twice the time, mostly in garbage
    collection.
    """
    members = {
        "time": _plain(block.time),
        "quaternion": _vectors(block.quaternion),
        "covariance_arcsec2": _matrices(block.covariance_arcsec2),
        "rate_deg_per_s": _vectors(block.rate_deg_per_s),
        "rate_origin": _plain(block.rate_origin),
        "status": _plain(block.status),
        "method": _plain(block.method),
        "residual_rms_arcsec": number_texts(block.residual_rms_arcsec.tolist()),
        "predicted_rms_arcsec": number_texts(block.predicted_rms_arcsec.tolist()),
        "stretch": number_texts(block.stretch.tolist()),
        "batch": _plain(block.batch),
        "id": _plain(block.id),
    }
    if block.revision[0]:
        members |= {
            "model": _plain(block.model),
            "revision": number_texts(block.revision.tolist()),
            "bias_deg_per_h": _vectors(block.bias_deg_per_h),
            "bias_sigma_deg_per_h": _vectors(block.bias_sigma_deg_per_h),
        }
    row = ",".join(f'"{name}":%s' for name in members)
    row = f"{{{row}}}"
    return (row % values for values in zip(*members.values(), strict=True))


def _plain(values: Texts) -> list[str]:
    plain = values.tolist()
    # Many values are equal.
    texts = {value: _ENCODER.encode(value).decode() for value in set(plain)}
    return [texts[value] for value in plain]


def _vectors(values: Vector) -> list[str]:
    """JSON arrays of the three or four numbers of each row, null where unknown."""
    text = _ENCODER.encode(values.tolist()).decode()[1:-1].replace("],[", "]\n[")
    return text.replace("[null,null,null]", "null").split("\n")


def _matrices(covariance: Vector) -> list[str]:
    return [
        f"[[{p11},{p12},{p13}],[{p12},{p22},{p23}],[{p13},{p23},{p33}]]"
        for p11, p12, p13, p22, p23, p33 in rows_of_texts(covariance)
    ]
