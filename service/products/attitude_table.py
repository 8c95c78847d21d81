"""Attitudes as a table."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from service.products.attitudes import AttitudeBlock, AttitudeSeries
from service.products.tables import Column, Page, Table
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
"""Of raw attitudes."""

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
"""Of filtered and smoothed attitudes."""


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
