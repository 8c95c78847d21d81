"""Conversion of packets to gyro blocks, each with the samples of a fixed period."""

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import msgspec

from service.errors import shown_value
from service.features.packets.batches import counted_change
from service.features.packets.clock import NS, Moment, finite, moment_of, whole
from service.features.packets.definition import PacketFault
from service.features.packets.mapping import PacketMap
from service.features.packets.stream import SpacePacket
from service.missions.mission import Mission
from service.missions.motion import largest_rate_deg_per_s
from service.times import parse_utc, shifted

MOST_SAMPLES = 10_000
"""Greatest number of samples in a gyro block, as in a request."""

LATEST = 16
"""Number of latest packets among which a repeated one is recognised."""

Values = Mapping[str, Any]
Axes = tuple[float, float, float]


@dataclass
class PacketBlock:
    """An unfinished gyro block, with its first packet."""

    packet: SpacePacket
    start_ns: int
    start: str
    tai_ns: list[int] = field(default_factory=list)
    rates: list[Axes] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Sample:
    tai_ns: int
    values: tuple[float, ...] | tuple[int, ...]


class GyroBlockMaker:
    """Converts packet values of one spacecraft, in order, to gyro blocks.

    A block ends at multiples of `block_s`, and if time goes back.  Its name consists of the APID
    and the time of its first sample.
    """

    def __init__(self, mission: Mission, mapped: PacketMap) -> None:
        assert mapped.table.gyro_blocks is not None
        self._spacecraft = mission.name
        self._mapped = mapped
        self._table = mapped.table.gyro_blocks
        self._largest = math.radians(largest_rate_deg_per_s(mission.gyro))
        self._turn = 1 << self._table.counter_bits
        self._block_ns = round(self._table.block_s * NS)
        self._before: _Sample | None = None
        self._latest: deque[list[_Sample]] = deque(maxlen=LATEST)
        self._pending: PacketBlock | None = None

    def add(self, packet: SpacePacket, values: Values) -> Iterator[PacketBlock]:
        """Add a packet; yields the blocks that the packet completes.

        Raises `PacketFault` for a packet without a usable sample.
        """
        if self._mapped.gyro_values[0][0] not in values:
            return
        moment = moment_of(self._table.time or self._mapped.table.time, values)
        rows = range(self._used(values))
        found = [self._sample(values, moment, row) for row in rows]
        if found in self._latest:
            # The packet was sent or stored twice.
            return
        for before, after in pairwise(found):
            if after.tai_ns <= before.tai_ns:
                name = ", ".join(self._mapped.gyro_offsets)
                raise PacketFault(name, "must rise from sample to sample")
        rates = self._rates(found)
        self._before = found[-1] if found else self._before
        self._latest.append(found)
        for sample, rate in rates:
            if (done := self._taken(packet, moment, sample, rate)) is not None:
                yield done

    def end(self) -> Iterator[PacketBlock]:
        """Yield the unfinished block, which waited for further samples."""
        pending, self._pending = self._pending, None
        if pending is not None:
            yield pending

    def json_of(self, block: PacketBlock, apid: int) -> bytes:
        """A gyro block as a JSON line of a telemetry file."""
        return msgspec.json.encode(
            {
                "spacecraft": self._spacecraft,
                "block": f"{apid}-{block.start}",
                "start": block.start,
                "times_s": [(each - block.start_ns) / NS for each in block.tai_ns],
                "rates_rad_per_s": block.rates,
            }
        )

    def _used(self, values: Values) -> int:
        table = self._table
        if table.count is None:
            return table.samples
        used = whole(values, table.count)
        if not 0 <= used <= table.samples:
            message = f"must be from 0 to {table.samples}, the number of samples"
            raise PacketFault(table.count, message, used)
        return used

    def _sample(self, values: Values, moment: Moment, row: int) -> _Sample:
        names = tuple(column[row] for column in self._mapped.gyro_values)
        later_s = 0.0
        if self._mapped.gyro_offsets:
            later_s = finite(values, self._mapped.gyro_offsets[row])
        elif self._table.step_s is not None:
            later_s = row * self._table.step_s
        tai_ns = moment.tai_ns + round(later_s * NS)
        if self._table.kind == "angle":
            return _Sample(tai_ns, tuple(whole(values, name) for name in names))
        return _Sample(tai_ns, tuple(finite(values, name) for name in names))

    def _rates(self, found: list[_Sample]) -> list[tuple[_Sample, Axes]]:
        """Samples with their rates; an angle without a recent previous sample is left out."""
        rates = []
        before = self._before
        for sample in found:
            if self._table.kind == "rate":
                units: tuple[float, ...] | None = sample.values
            else:
                units = self._changes(before, sample)
            before = sample
            if units is not None:
                x, y, z = (
                    unit * scale for unit, scale in zip(units, self._table.scale_rad, strict=True)
                )
                self._require_believed((x, y, z))
                rates.append((sample, (x, y, z)))
        return rates

    def _changes(self, before: _Sample | None, sample: _Sample) -> tuple[float, ...] | None:
        """Counts per second since the sample before; None without one in time."""
        if before is None:
            return None
        passed_s = (sample.tai_ns - before.tai_ns) / NS
        if not 0.0 < passed_s <= self._table.max_gap_s:
            return None
        return tuple(
            counted_change(int(now) - int(then), self._turn) / passed_s
            for now, then in zip(sample.values, before.values, strict=True)
        )

    def _require_believed(self, rates: Axes) -> None:
        """Raise `PacketFault` for a rate beyond the mission's largest.

        Checked per sample rather than per block, so that the other samples are kept.
        """
        for axis, rate in enumerate(rates):
            if abs(rate) > self._largest:
                raise PacketFault(
                    f"{self._mapped.gyro_values[axis][0]}",
                    f"gives a rate about axis {axis + 1} beyond the largest of "
                    f"{self._spacecraft}, {self._largest:.6g} rad/s",
                    shown_value(rate),
                )

    def _taken(
        self, packet: SpacePacket, moment: Moment, sample: _Sample, rate: Axes
    ) -> PacketBlock | None:
        """Add a sample to the unfinished block; returns the block that the sample ends, or None."""
        pending, done = self._pending, None
        if pending is not None and (
            sample.tai_ns // self._block_ns != pending.start_ns // self._block_ns
            or sample.tai_ns <= pending.tai_ns[-1]
            or len(pending.tai_ns) == MOST_SAMPLES
        ):
            done, pending = pending, None
        if pending is None:
            later_s = (sample.tai_ns - moment.tai_ns) / NS
            start = shifted(parse_utc(moment.text), later_s)
            pending = self._pending = PacketBlock(packet, sample.tai_ns, start.text)
        pending.tai_ns.append(sample.tai_ns)
        pending.rates.append(rate)
        return done
