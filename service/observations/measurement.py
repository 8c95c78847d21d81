"""An attitude that a star tracker measured itself, as a batch carries it."""

from collections.abc import Sequence
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, model_validator

from service.observations.numbers import Number, Quaternion, ReferenceFrame
from service.observations.prediction import PositiveDefinite, Row

LEAST_SIGMA_ARCSEC, LARGEST_SIGMA_ARCSEC = 1e-3, 36_000.0
LEAST_RATIO = 1e-10
"""Of the least variance to the largest: a covariance of less is no better than singular."""


def _of_a_tracker(rows: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
    variances = np.linalg.eigvalsh(np.array(rows)).tolist()
    least, largest = LEAST_SIGMA_ARCSEC**2, LARGEST_SIGMA_ARCSEC**2
    if variances[0] < least or variances[-1] > largest:
        raise ValueError(
            f"must have sigmas from {LEAST_SIGMA_ARCSEC:g} to {LARGEST_SIGMA_ARCSEC:g} arcsec "
            "about every axis"
        )
    _require_ratio(variances)
    return rows


def _of_one_tracker(sigmas: tuple[float, float, float]) -> tuple[float, float, float]:
    _require_ratio([sigma**2 for sigma in sigmas])
    return sigmas


def _require_ratio(variances: Sequence[float]) -> None:
    if min(variances) < LEAST_RATIO * max(variances):
        raise ValueError(f"must have no sigma below {LEAST_RATIO**0.5:g} of the largest")


def none_beside_measurement(prior: Any, info: ValidationInfo) -> Any:
    """The a priori knowledge of a batch, which must be null if it holds a measured attitude."""
    if prior is not None and info.data.get("measurement") is not None:
        raise ValueError("must be null: a measured attitude needs no a priori knowledge")
    return prior


def no_options_beside_measurement(options: Any, info: ValidationInfo) -> Any:
    """The options of a batch, which must be left out if it holds a measured attitude."""
    if options.model_fields_set and info.data.get("measurement") is not None:
        raise ValueError("must be left out: a measured attitude is not searched for")
    return options


Sigma = Annotated[Number, Field(ge=LEAST_SIGMA_ARCSEC, le=LARGEST_SIGMA_ARCSEC)]


class MeasurementIn(BaseModel):
    """An attitude that a star tracker measured itself, with its covariance or its sigmas."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    quaternion: Quaternion
    """Scalar last, inertial to the axes of `tracker`, or to the body without it."""
    tracker: Annotated[
        str | None, Field(min_length=1, max_length=128, pattern=r"^[^\x00-\x1f\x7f]+$")
    ] = None
    """Whose axes are meant; the mission's alignment turns them into the body's."""
    sigma_arcsec: Annotated[tuple[Sigma, Sigma, Sigma], AfterValidator(_of_one_tracker)] | None = (
        None
    )
    """One sigma of the rotation about each of the same axes."""
    covariance_arcsec2: Annotated[PositiveDefinite, AfterValidator(_of_a_tracker)] | None = None
    """Of the small rotation about the same axes, in place of the sigmas."""
    frame: ReferenceFrame = "EME2000"

    @model_validator(mode="after")
    def _one_accuracy(self) -> Self:
        if (self.sigma_arcsec is None) == (self.covariance_arcsec2 is None):
            raise ValueError("needs either sigma_arcsec or covariance_arcsec2")
        return self
