"""Attitudes as a product: with their stretch and their rate."""

from typing import Annotated, ClassVar, Literal

from service.storage.models.base import (
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
    """An attitude of a series."""

    component: ClassVar[str] = "ProductAttitude"
    time: Moment
    quaternion: ContinuousQuaternion
    covariance_arcsec2: Covariance
    rate_deg_per_s: Annotated[
        Components | None, doc("Of the body relative to inertial, in body axes; null: unknown.")
    ]
    rate_origin: Annotated[
        Literal["own", "derived", "none"],
        doc("`own`: of the batch. `derived`: from the attitudes before and after."),
    ]
    status: Status
    method: Annotated[str, DescribedAs(Literal["quest", "triad"])]
    residual_rms_arcsec: float
    predicted_rms_arcsec: float
    stretch: Annotated[Count, doc("Number of the unbroken stretch, from 0.")]
    batch: str
    id: Id


class AttitudeProduct(Record, frozen=True, kw_only=True):
    """Attitudes in order of time."""

    component: ClassVar[str] = "AttitudeProduct"
    about: Annotated[dict[str, str], doc("Where the attitudes come from: filters and origin.")]
    items: list[ProductAttitude]
