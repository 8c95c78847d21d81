"""API records of exported attitudes: a series, and the attitude at a given time."""

from typing import Annotated, Literal

from msgspec import UNSET, UnsetType

from service.contract.base import (
    Components,
    Count,
    Covariance,
    DescribedAs,
    Id,
    Moment,
    Record,
    Status,
    doc,
)

ContinuousQuaternion = Annotated[
    list[float],
    doc(
        "Transforms inertial into body components; scalar last. Signs are continuous within a "
        "stretch, so qc may be negative."
    ),
]


class ProductAttitude(Record, frozen=True, kw_only=True):
    """An attitude of an exported series."""

    time: Moment
    quaternion: ContinuousQuaternion
    covariance_arcsec2: Covariance
    rate_deg_per_s: Components | None
    """Rate of the body relative to inertial space, in body axes; null: unknown."""
    rate_origin: Literal["own", "derived", "estimated", "none"]
    """Origin of the rate. `own`: of the batch. `derived`: from the attitudes before and after.
    `estimated`: by the filter.
    """
    status: Status
    method: Annotated[
        str, DescribedAs(Literal["quest", "triad", "measured", "ekf", "filter_smoother"])
    ]
    """Method of estimation; `ekf` for the grade `filtered`, `filter_smoother` for `smoothed`."""
    residual_rms_arcsec: float | None
    """Root mean square residual; null unless the grade is `raw` and the attitude is of stars."""
    predicted_rms_arcsec: Annotated[float | None, doc("null unless the grade is `raw`.")]
    stretch: Annotated[Count, doc("Number of the unbroken stretch, from 0.")]
    batch: Annotated[str | None, doc("null unless the grade is `raw`.")]
    id: Annotated[Id, doc("The result's id; unless the grade is `raw`, the revision's.")]
    model: Literal["gyro", "constant_rate"] | UnsetType = UNSET
    """The filter's model of the motion: the rates of a gyro, or a constant rate with a random walk.
    Absent if the grade is `raw`.
    """
    revision: int | UnsetType = UNSET
    """Number of the revision of the day's attitudes, from 1. Absent if the grade is `raw`."""
    bias_deg_per_h: Components | UnsetType | None = UNSET
    """Bias of the gyro, in body axes; null at a constant rate. Absent if the grade is `raw`."""
    bias_sigma_deg_per_h: Components | UnsetType = UNSET
    """One sigma of the bias or, at a constant rate, of the rate. Absent if the grade is `raw`."""


class AttitudeProduct(Record, frozen=True, kw_only=True):
    """A series of attitudes in order of time."""

    about: Annotated[dict[str, str], doc("Where the attitudes come from: filters and origin.")]
    items: list[ProductAttitude]


class AttitudeAtMoment(Record, frozen=True, kw_only=True):
    """The attitude at a given time, with its error."""

    time: Moment
    method: Literal["nearest", "interpolated"]
    quaternion: ContinuousQuaternion
    covariance_arcsec2: Covariance
    """Covariance due to the attitudes used and the motion. Errors of two batches are independent;
    between filtered or smoothed samples the covariance is the weighted mean.
    """
    motion_arcsec: float | None
    """Error due to the motion. Nearest: the angle that the body turns until the requested time.
    Interpolated: an eighth of the step times the change of the rate, over more than a quarter turn
    a bound from the rates. Null: no rate is known.
    """
    offset_s: Annotated[float, doc("From the moment to the nearest attitude that was used.")]
    ids: Annotated[list[Id], doc("The results that were used.")]
