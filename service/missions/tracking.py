"""How a mission predicts the attitude of a batch from the last good one."""

from functools import cached_property
from typing import Self

from pydantic import Field, field_validator, model_validator

from service.errors import BadInput
from service.missions.strict import Strict
from service.times import Utc, parse_utc

FLOOR_DEG, CEILING_DEG = 0.1, 3.0
MAX_AGE_S = 3600.0
BODY_RATE_SIGMA_DEG_PER_S = 0.001
"""Of the rates that batches carry, where a mission names no other."""


class Flip(Strict):
    """A manoeuvre through which no attitude is carried, such as SOHO's turns by 180 deg."""

    start: str
    end: str

    @field_validator("start", "end")
    @classmethod
    def _is_time(cls, text: str) -> str:
        try:
            parse_utc(text)
        except BadInput as error:
            raise ValueError(error.faults[0].message) from None
        return text

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        start_ns, end_ns = self._span_ns
        if end_ns <= start_ns:
            raise ValueError("end: must come after start")
        return self

    def lies_between(self, first: Utc, last: Utc) -> bool:
        """Whether it is under way at some time from `first` to `last`."""
        start_ns, end_ns = self._span_ns
        return first.tai_ns < end_ns and start_ns < last.tai_ns

    @cached_property
    def _span_ns(self) -> tuple[int, int]:
        return parse_utc(self.start).tai_ns, parse_utc(self.end).tai_ns


class TrackingSettings(Strict):
    """The prediction of an attitude: how old, how sure, and for which batches."""

    default: bool = False
    """Batches whose `a_priori` is null are tracked as if it were {"from": "last"}."""
    max_age_s: float = Field(default=MAX_AGE_S, gt=0, le=86_400)
    """An older attitude predicts nothing."""
    floor_deg: float = Field(default=FLOOR_DEG, ge=0.001, le=20)
    """A zone reaches beyond the field of view by this at least."""
    ceiling_deg: float = Field(default=CEILING_DEG, ge=0.001, le=60)
    """And by this at most; a prediction of which one sigma is more predicts nothing."""
    body_rate_sigma_deg_per_s: float = Field(default=BODY_RATE_SIGMA_DEG_PER_S, ge=0, le=10)
    """One sigma of the rates that batches carry, about each axis."""
    flips: tuple[Flip, ...] = Field(default=(), max_length=1000)
    """An attitude from before the end of one predicts nothing after its start."""

    @model_validator(mode="after")
    def _floor_below_ceiling(self) -> Self:
        if self.floor_deg > self.ceiling_deg:
            raise ValueError("floor_deg: must not be above ceiling_deg")
        return self


class LiveFilterSettings(Strict):
    """The filter of live data; off where the mission has no such table."""

    every_s: float = Field(default=10.0, ge=0.1, le=3600)
    """Seconds from one look at what was recorded to the next, at least."""


class SmoothingSettings(Strict):
    """When the service makes the definitive attitude by itself."""

    daily: bool = False
    """Each UTC day of live data, two hours and ten minutes after its end."""
