"""Numbers, vectors and quaternions as bodies carry them, for the models of pydantic."""

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

NORM_TOLERANCE = 1e-3

ReferenceFrame = Literal["EME2000", "ICRF", "GCRF"]


def _near_unit(components: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*components)
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise ValueError(f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}")
    return components


Number = Annotated[float, Field(strict=True)]
"""Strict: JSON's true and "5.3" are no numbers, though pydantic would take them for some."""
Components = tuple[Number, Number, Number]
UnitVector = Annotated[Components, AfterValidator(_near_unit)]
Quaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_near_unit)]
