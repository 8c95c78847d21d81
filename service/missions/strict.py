"""The ground rules of every table of a mission file: nothing unknown, no NaN, no infinity."""

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """A table whose unknown keys are refused; its values do not change."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)
