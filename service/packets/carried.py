"""What one packet leaves for the stars of later ones: a priori attitude, gyro counts, rates."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from service.missions.packets import PacketGyro, PacketMeasurement, PacketPrior
from service.observations.numbers import NORM_TOLERANCE
from service.packets.clock import NS, Moment
from service.packets.definition import PacketFault
from service.packets.values import finite_all, number, whole


@dataclass(frozen=True, slots=True)
class PacketAttitude:
    """An a priori attitude: scalar last, inertial to body, and its time."""

    moment: Moment
    quaternion: tuple[float, float, float, float]


def quaternion_in(
    values: Mapping[str, Any], names: Sequence[str], table: PacketPrior | PacketMeasurement
) -> tuple[float, float, float, float] | None:
    """The quaternion of a packet; None where it is zero or not finite: there is no attitude.

    Raises `PacketFault` for a norm other than 1.
    """
    numbers = [number(values, name) for name in names]
    if not all(map(math.isfinite, numbers)) or not any(numbers):
        return None
    norm = math.hypot(*numbers)
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise PacketFault(
            ", ".join(names), f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}"
        )
    if table.scalar == "first":
        numbers = [*numbers[1:], numbers[0]]
    x, y, z, scalar = numbers
    if table.direction == "body_to_inertial":
        return -x, -y, -z, scalar
    return x, y, z, scalar


def counted_change(counts: int, turn: int) -> int:
    """The change nearest to zero of a counter that starts again after `turn` counts."""
    half = turn // 2
    return (counts + half) % turn - half


class GyroRates:
    """Body rates from the counts of a gyro."""

    def __init__(self, gyro: PacketGyro, names: Sequence[str]) -> None:
        self._gyro = gyro
        self._names = names
        self._turn = 1 << gyro.counter_bits
        self._last: tuple[int, tuple[int, ...]] | None = None

    def add(self, values: Mapping[str, Any], moment: Moment) -> list[float] | None:
        """The rates in deg/s at a packet; None where an angle has no packet just before."""
        gyro = self._gyro
        if gyro.kind == "rate":
            counts = finite_all(values, self._names)
            return [count * scale for count, scale in zip(counts, gyro.scale_deg, strict=True)]
        angles = tuple(whole(values, name) for name in self._names)
        before, self._last = self._last, (moment.tai_ns, angles)
        if before is None:
            return None
        passed_s = (moment.tai_ns - before[0]) / NS
        if not 0.0 < passed_s <= gyro.max_gap_s:
            return None
        return [
            counted_change(now - then, self._turn) * scale / passed_s
            for now, then, scale in zip(angles, before[1], gyro.scale_deg, strict=True)
        ]


class Held:
    """Values of the latest packet that had them, with their time."""

    def __init__(self, within_s: float) -> None:
        self._within_ns = round(within_s * NS)
        self._moment: Moment | None = None
        self._values: list[float] | None = None

    def hold(self, moment: Moment, values: list[float] | None) -> None:
        """Take values in place of those before; None: there are none any more."""
        self._moment, self._values = moment, values

    def near(self, moment: Moment) -> list[float] | None:
        """The values, if their time is near enough to a moment."""
        if self._moment is None or abs(self._moment.tai_ns - moment.tai_ns) > self._within_ns:
            return None
        return self._values
