"""The ground rules of every table of a mission file: nothing unknown, no NaN, no infinity."""

from collections.abc import Mapping
from typing import Any, Self

from pydantic import BaseModel, ConfigDict


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
    """Whether a table was left out of the file: then it is no part of the mission's digest."""
    return table is None
