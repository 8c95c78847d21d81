"""Gyro blocks and their samples."""

from collections.abc import Sequence

from ..base import Model


class GyroBlock(Model, frozen=True, kw_only=True):
    """A recorded gyro block; `step_s` is None where the block has times of its own."""

    id: str
    spacecraft: str
    run: str
    block: str
    start: str
    end: str
    samples: int
    step_s: float | None
    received: str


class GyroSamples(GyroBlock, frozen=True, kw_only=True):
    """A recorded gyro block with its samples; the times are seconds of TAI after `start`."""

    times_s: Sequence[float]
    rates_rad_per_s: Sequence[Sequence[float]]
