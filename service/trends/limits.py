"""Limits: the bounds of a quantity by severity.

A value is computed over the latest `minimum_count` batches together.  It is out of a bound when it
lies beyond it, and stays out until it has come back by `hysteresis`.  It counts only once it has
been out for `duration_s` of batch time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Annotated, NamedTuple, Self

from pydantic import Field, StrictBool, model_validator

from service.missions.strict import Strict
from service.times import Utc

MAX_COUNT = 200
"""Largest number of batches for one value: its samples are written with every batch."""
LONGEST_S = 7 * 86400.0


class Severity(IntEnum):
    """Severity of an alarm; a greater number is worse."""

    WATCH = 1
    WARNING = 2
    CRITICAL = 3

    @property
    def word(self) -> str:
        """Severity as a word of the interface."""
        return self.name.lower()


class Bounds(Strict):
    """Bounds of one severity: a value below `low` or above `high` is out; null: no bound."""

    low: float | None = None
    high: float | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"low {self.low:g} must be less than high {self.high:g}")
        return self


class LimitSettings(Strict):
    """Limits of one quantity: bounds by severity, hysteresis and duration."""

    enabled: StrictBool = True
    watch: Bounds = Bounds()
    warning: Bounds = Bounds()
    critical: Bounds = Bounds()
    hysteresis: Annotated[
        float,
        Field(ge=0, description="How far inside a bound the value must return."),
    ] = 0.0
    minimum_count: Annotated[
        int,
        Field(
            ge=1,
            le=MAX_COUNT,
            description="Batches that are evaluated together; before that, none is.",
        ),
    ] = 20
    duration_s: Annotated[
        float,
        Field(ge=0, le=LONGEST_S, description="Batch time for which the value must have been out."),
    ] = 60.0

    @model_validator(mode="after")
    def _worse_is_further_out(self) -> Self:
        levels = [self.bounds(severity) for severity in Severity]
        highs = [each.high for each in levels if each.high is not None]
        lows = [each.low for each in levels if each.low is not None]
        if highs != sorted(highs) or lows != sorted(lows, reverse=True):
            raise ValueError("a worse severity must not have the narrower bound")
        return self

    def bounds(self, severity: Severity) -> Bounds:
        """Bounds of a severity in these limits."""
        found: Bounds = getattr(self, severity.word)
        return found

    def out(self, severity: Severity, value: float, was_out: bool) -> bool:
        """True if limits are on and a value exceeds a bound, or is not back by the hysteresis."""
        bounds, within = self.bounds(severity), self.hysteresis if was_out else 0.0
        above = bounds.high is not None and value > bounds.high - within
        below = bounds.low is not None and value < bounds.low + within
        return self.enabled and (above or below)

    @cached_property
    def _levels(self) -> tuple[tuple[Severity, float, float], ...]:
        """Each severity with its bounds, infinite if not set; empty if the limits are off."""
        levels = ((severity, self.bounds(severity)) for severity in Severity)
        return tuple(
            (
                severity,
                -math.inf if each.low is None else each.low,
                math.inf if each.high is None else each.high,
            )
            for severity, each in levels
            if self.enabled
        )

    @cached_property
    def inner_bounds(self) -> tuple[float, float]:
        """Range of values inside every bound; infinite where none is set."""
        lows, highs = ([level[k] for level in self._levels] for k in (1, 2))
        return max(lows, default=-math.inf), min(highs, default=math.inf)

    def severities_out(self, value: float) -> list[Severity]:
        """Severities whose bounds a value exceeds, without hysteresis; worst last."""
        return [s for s, low, high in self._levels if value < low or value > high]

    def beyond(self, severity: Severity, value: float) -> float:
        """Distance of a value beyond the bounds of a severity; negative inside them."""
        bounds = self.bounds(severity)
        above = -math.inf if bounds.high is None else value - bounds.high
        below = -math.inf if bounds.low is None else bounds.low - value
        return max(above, below)

    def bound(self, severity: Severity, value: float) -> float:
        """Bound of a severity that is nearest to a value out of it."""
        bounds = self.bounds(severity)
        middle = [each for each in (bounds.low, bounds.high) if each is not None]
        return min(middle, key=lambda each: abs(value - each))


def above(watch: float | None, warning: float, critical: float, **others: float) -> LimitSettings:
    """Limits with upper bounds only; `others` are further settings by name."""
    highs = {"watch": watch, "warning": warning, "critical": critical}
    bounds = {name: {"high": high} for name, high in highs.items()}
    return LimitSettings.model_validate(bounds | others)


def about_zero(watch: float, warning: float, critical: float, hysteresis: float) -> LimitSettings:
    """Limits with bounds of equal size on both sides of zero."""
    sizes = {"watch": watch, "warning": warning, "critical": critical}
    bounds = {name: {"low": -size, "high": size} for name, size in sizes.items()}
    return LimitSettings.model_validate(bounds | {"hysteresis": hysteresis})


Sample = tuple[int, float, float]
"""Sample of a quantity: (time_ns, part, whole), a fraction of counts, or a value over one."""


class RecordedSample(NamedTuple):
    """Sample of a batch as it was recorded, with the batch's place in the order of recording."""

    sample: Sample
    seq: int
    batch_id: str


@dataclass(frozen=True)
class SampledDay:
    """Quantity measured over a whole UTC day; `created` is the time of its recording."""

    quantity: str
    run: str
    start: Utc
    samples: Sequence[Sample]
    """Samples of the quantity in order of time."""
    revision: int
    """Number of the day's record, from 1; it grows with each repetition."""
    created: str
