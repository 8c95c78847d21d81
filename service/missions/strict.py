"""The ground rules of every table of a mission file: nothing unknown, no NaN, no infinity."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict

Components = tuple[float, float, float]


def _has_direction(vector: Components) -> Components:
    if math.hypot(*vector) <= 1e-6:
        raise ValueError("has no direction: give a unit vector")
    return vector


Direction = Annotated[Components, AfterValidator(_has_direction)]


class Strict(BaseModel):
    """A table whose unknown keys are refused; its values do not change."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with other values, and with nothing that was worked out from the old ones."""
        copied = super().model_copy(update=update, deep=deep)
        for name in vars(copied).keys() - type(self).model_fields.keys():
            del vars(copied)[name]
        return copied


def is_missing(table: object) -> bool:
    """True if a table was left out of the file: it is then no part of the mission's digest."""
    return table is None
