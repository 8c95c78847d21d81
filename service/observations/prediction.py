"""The prediction that a batch with `a_priori: {"from": "last"}` is recorded with."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from service.observations.numbers import Components, Number

Row = Components
NoPrediction = Literal["no_good_attitude", "too_uncertain", "flip"]
RateSource = Literal["gyro", "body_rates", "attitudes", "unknown"]


def _positive_definite(rows: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
    matrix = np.array(rows)
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError("must be positive definite") from None
    if not np.array_equal(matrix, matrix.T):
        raise ValueError("must be symmetric")
    return rows


PositiveDefinite = Annotated[tuple[Row, Row, Row], AfterValidator(_positive_definite)]


class PredictionIn(BaseModel):
    """The attitude that was predicted for a batch, or why there was none.

    The service adds it when it records a batch.  A batch that is sent with it is searched about it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    quaternion: tuple[Number, Number, Number, Number] | None = None
    """Inertial to body, scalar last."""
    covariance_arcsec2: PositiveDefinite | None = None
    """Of the rotation about the body axes."""
    margin_deg: Annotated[Number, Field(gt=0, le=60)] | None = None
    """By which the zone reaches beyond the field of view."""
    result: Annotated[str, Field(max_length=26)] | None = None
    """The result whose attitude it came from."""
    age_s: Annotated[Number, Field(ge=0)] | None = None
    rate: RateSource | None = None
    """What told how the body turned since then."""
    reason: NoPrediction | None = None
    """Why nothing was predicted."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.reason is not None:
            if self.quaternion is not None:
                raise ValueError("takes either quaternion or reason, not both")
        elif None in (self.quaternion, self.covariance_arcsec2, self.margin_deg):
            raise ValueError("needs reason, or quaternion, covariance_arcsec2 and margin_deg")
        if self.quaternion is not None and abs(np.linalg.norm(self.quaternion) - 1.0) > 1e-3:
            raise ValueError("quaternion: must have norm 1 within 0.001")
        return self
