"""Attitudes as a table, and as JSON whose items are written as they are read."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from service.products.attitudes import AttitudeBlock, AttitudeSeries, Texts
from service.products.tables import Column, Page, Table, number_texts, rows_of_texts
from service.vectors import Vector

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
"""The columns of raw attitudes."""

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
"""The columns of filtered and smoothed attitudes."""


def attitude_table(series: AttitudeSeries) -> Table:
    """The table of a series, a row an attitude."""
    columns = COLUMNS if series.about.grade == "raw" else ESTIMATED_COLUMNS
    about = {"product": "attitude", **series.about.provenance()}
    return Table(columns, _pages(series, [each.name for each in columns]), about)


def _pages(series: AttitudeSeries, names: Sequence[str]) -> Iterator[Page]:
    for block in series.blocks:
        values = page_of(block)
        yield [values[name] for name in names]


def page_of(block: AttitudeBlock) -> dict[str, list[Any]]:
    """The values of every column by its name, as plain values; what is not known is None."""
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
    """Write the series: `about` and its `items`, an object an attitude."""
    yield b'{"about":' + _ENCODER.encode(series.about.provenance()) + b',"items":['
    is_first = True
    for block in series.blocks:
        text = ",".join(_items(block)).encode()
        yield text if is_first else b"," + text
        is_first = False
    yield b"]}"


def _items(block: AttitudeBlock) -> Iterator[str]:
    """The attitudes of a block as objects.

    They are put together from texts: plain objects take twice the time, most of it to
    collect garbage.
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
    if len(block) and block.revision[0]:
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
    # Many are the same.
    texts = {value: _ENCODER.encode(value).decode() for value in set(plain)}
    return [texts[value] for value in plain]


def _vectors(values: Vector) -> list[str]:
    """Arrays of the three or four numbers of each row, null where they are not known."""
    if not len(values):
        return []
    text = _ENCODER.encode(values.tolist()).decode()[1:-1].replace("],[", "]\n[")
    return text.replace("[null,null,null]", "null").split("\n")


def _matrices(covariance: Vector) -> list[str]:
    return [
        f"[[{p11},{p12},{p13}],[{p12},{p22},{p23}],[{p13},{p23},{p33}]]"
        for p11, p12, p13, p22, p23, p33 in rows_of_texts(covariance)
    ]
