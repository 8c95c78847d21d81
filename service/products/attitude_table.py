"""Attitudes as a table."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from service.products.attitudes import AttitudeBlock, AttitudeSeries
from service.products.tables import Column, Page, Table
from service.vectors import Vector

_BODY, _INERTIAL = "SC_BODY_1", "EME2000"
_TO_BODY = f"{_INERTIAL} to {_BODY}"
_COVARIANCE = ("11", "12", "13", "22", "23", "33")

COLUMNS = (
    Column("time", "text", "UTC", description="Time of the batch.", width=30),
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


def attitude_table(series: AttitudeSeries) -> Table:
    """The table of a series, a row an attitude."""
    return Table(COLUMNS, _pages(series), {"product": "attitude", **series.about.provenance()})


def _pages(series: AttitudeSeries) -> Iterator[Page]:
    for block in series.blocks:
        yield page_of(block)


def page_of(block: AttitudeBlock) -> list[list[Any]]:
    """The values of every column, as plain values; a rate that is not known is None."""
    rates: list[list[Any]] = block.rate_deg_per_s.T.tolist()
    if np.isnan(block.rate_deg_per_s).any():
        rates = [[None if value != value else value for value in axis] for axis in rates]
    return [
        block.time.tolist(),
        block.time_ns.tolist(),
        *_columns(block.quaternion),
        *_columns(block.covariance_arcsec2),
        *rates,
        block.rate_origin.tolist(),
        block.status.tolist(),
        block.method.tolist(),
        block.residual_rms_arcsec.tolist(),
        block.predicted_rms_arcsec.tolist(),
        block.stretch.tolist(),
        block.batch.tolist(),
        block.id.tolist(),
    ]


def _columns(values: Vector) -> list[list[float]]:
    columns: list[list[float]] = values.T.tolist()
    return columns
