"""A gyro beside a drawn pass: its samples, as blocks, with the errors that gyros have.

Between two batches the body turns at a constant rate from one true attitude to the next.  The gyro
integrates that rate about its axes: it has a bias that walks, noise, errors of scale and
alignment (Farrenkopf's model), counts whole steps of angle, may fall silent, and its clock,
which is also that of the trackers, may step.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from service.errors import BadInput, Fault, shown_value
from service.missions.mission import Mission
from service.missions.motion import GyroSettings
from service.simulate.telemetry import DrawnBatch
from service.times import Utc, parse_utc, shifted
from service.vectors import ARCSEC_PER_RADIAN, Vector, rotation_vectors

SAMPLES_OF_A_BLOCK = 1_000
GAP_AT, CLOCK_STEP_AT = 0.4, 0.7
"""Shares of the pass at which a gap begins and the clock steps."""
_DIGITS = 12
"""The digits of a rate in rad/s: far below the noise of any gyro."""


@dataclass(frozen=True)
class GyroWanted:
    """How the gyro samples, and what befalls it; its noise is that of the mission."""

    step_s: float = 1.0
    quantum_arcsec: float = 0.0
    gap_s: float = 0.0
    clock_step_s: float = 0.0

    def __post_init__(self) -> None:
        for name, least, most in (
            ("step_s", 0.01, 3600.0),
            ("quantum_arcsec", 0.0, 3600.0),
            ("gap_s", 0.0, 86_400.0),
            ("clock_step_s", 0.0, 3600.0),
        ):
            value = getattr(self, name)
            if not least <= value <= most:
                message = f"must be from {least:g} to {most:g}"
                raise BadInput(Fault(f"gyro {name}", message, shown_value(value)))


def with_gyro(
    drawn: Iterable[DrawnBatch], mission: Mission, wanted: GyroWanted, duration_s: float, seed: int
) -> Iterator[DrawnBatch]:
    """The batches of a pass of a known duration, each with the gyro blocks that end by then.

    Raises `BadInput` for a mission that does not describe its gyro.
    """
    if mission.gyro is None:
        message = "its mission file has no table [gyro], which names the noise"
        raise BadInput(Fault("gyro", message, mission.name))
    gyro = _Gyro(mission.name, mission.gyro, wanted, duration_s, seed)
    before: DrawnBatch | None = None
    for each in drawn:
        if before is None:
            gyro.begin(each)
        else:
            gyro.turn(before, each)
        if before is not None:
            yield replace(gyro.by_its_clock(before), gyro=gyro.full_blocks())
        before = each
    if before is not None:
        yield replace(gyro.by_its_clock(before), gyro=[*gyro.full_blocks(), *gyro.rest()])


class _Gyro:
    """A gyro at work: its errors, and the samples that are not in a block yet.

    Times are seconds since the first batch, by a true clock.
    """

    def __init__(
        self,
        spacecraft: str,
        settings: GyroSettings,
        wanted: GyroWanted,
        duration_s: float,
        seed: int,
    ) -> None:
        self._spacecraft, self._settings, self._wanted = spacecraft, settings, wanted
        rng = self._rng = np.random.default_rng([seed, *spacecraft.encode(), 2])
        self._gap = GAP_AT * duration_s, GAP_AT * duration_s + wanted.gap_s
        self._stepped_at = CLOCK_STEP_AT * duration_s
        self._bias = rng.normal(0.0, settings.bias_sigma_rad_s, 3)
        errors = rng.normal(0.0, settings.misalignment_arcsec / ARCSEC_PER_RADIAN, (3, 3))
        np.fill_diagonal(errors, rng.normal(0.0, settings.scale, 3))
        self._measured_from_true = np.eye(3) + errors
        self._gyro_from_body = np.linalg.inv(settings.body_from_gyro)
        self._angle = np.zeros(3)
        self._counted = np.zeros(3)
        self._turned = np.zeros(3)
        self._samples = 0
        self._at_s = 0.0
        self._start: Utc | None = None
        self._block: list[list[float]] = []
        self._block_start_s = 0.0
        self._blocks: list[dict[str, Any]] = []

    def begin(self, first: DrawnBatch) -> None:
        """Begin with the time of the first batch."""
        self._start = parse_utc(first.truth["time"])

    def turn(self, before: DrawnBatch, after: DrawnBatch) -> None:
        """Sample the turn from a batch to the next."""
        quaternions = np.array([each.truth["quaternion"] for each in (before, after)])
        times = [parse_utc(each.truth["time"]).tai_ns for each in (before, after)]
        assert self._start is not None
        end_s = (times[1] - self._start.tai_ns) * 1e-9
        rate = rotation_vectors(*quaternions) / ((times[1] - times[0]) * 1e-9)
        while (next_s := self._samples * self._wanted.step_s) <= end_s + 1e-9:
            self._turned += rate * (next_s - self._at_s)
            # The first sample is of a step before the pass, at the same rate.
            step = rate * self._wanted.step_s if self._samples == 0 else self._turned
            self._sample(next_s, step)
            self._at_s, self._turned = next_s, np.zeros(3)
        self._turned += rate * (end_s - self._at_s)
        self._at_s = end_s

    def by_its_clock(self, batch: DrawnBatch) -> DrawnBatch:
        """A batch with the time of the clock that has stepped."""
        assert self._start is not None
        true = parse_utc(batch.truth["time"])
        later_s = self._later_s((true.tai_ns - self._start.tai_ns) * 1e-9)
        if not later_s:
            return batch
        time = shifted(true, later_s).text
        return replace(
            batch, batch=batch.batch | {"time": time}, truth=batch.truth | {"time": time}
        )

    def full_blocks(self) -> list[dict[str, Any]]:
        """The blocks that are finished, once."""
        blocks, self._blocks = self._blocks, []
        return blocks

    def rest(self) -> list[dict[str, Any]]:
        """The last block."""
        self._end_block()
        return self.full_blocks()

    def _sample(self, at_s: float, turned: Vector) -> None:
        """Take a sample of the turn (3,) since the one before, in radians about the body axes."""
        step_s, settings = self._wanted.step_s, self._settings
        walk = self._rng.normal(0.0, settings.sigma_u_rad_s1_5 * step_s**0.5, 3)
        mean_bias = self._bias + 0.5 * walk
        self._bias = self._bias + walk
        sigma_rad = (
            settings.sigma_v_rad_s0_5**2 * step_s + settings.sigma_u_rad_s1_5**2 * step_s**3 / 12.0
        ) ** 0.5
        noise = self._rng.normal(0.0, sigma_rad, 3)
        self._angle += self._measured_from_true @ turned + mean_bias * step_s + noise
        counted = self._gyro_from_body @ self._angle
        if quantum := self._wanted.quantum_arcsec / ARCSEC_PER_RADIAN:
            counted = np.floor(counted / quantum) * quantum
        rate, self._counted = (counted - self._counted) / step_s, counted
        self._samples += 1
        is_silent = self._wanted.gap_s and self._gap[0] < at_s < self._gap[1]
        # A block has one step: it ends at a gap, and where the clock steps.
        steps_now = self._later_s(at_s) != self._later_s(at_s - step_s)
        if is_silent or steps_now or len(self._block) == SAMPLES_OF_A_BLOCK:
            self._end_block()
        if is_silent:
            return
        if not self._block:
            self._block_start_s = at_s
        self._block.append(np.round(rate, _DIGITS).tolist())

    def _end_block(self) -> None:
        if not self._block:
            return
        assert self._start is not None
        start = shifted(self._start, self._block_start_s + self._later_s(self._block_start_s))
        self._blocks.append(
            {
                "spacecraft": self._spacecraft,
                "block": f"{start.text[:4]}-{start.day_of_year:03d}-{start.text[11:]}",
                "start": start.text,
                "step_s": self._wanted.step_s,
                "rates_rad_per_s": self._block,
            }
        )
        self._block = []

    def _later_s(self, at_s: float) -> float:
        """How much later than the true time the clock is."""
        return self._wanted.clock_step_s if at_s >= self._stepped_at else 0.0
