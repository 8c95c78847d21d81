"""Conversion of packet values to batches of stars and of measured attitudes."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from service.errors import BadBatch, Fault
from service.features.packets import clock
from service.features.packets.definition import PacketFault
from service.features.packets.mapping import MeasurementColumns, PacketMap, TrackerColumns
from service.features.packets.stream import SpacePacket
from service.missions.packets import PacketGyro, PacketMeasurement, PacketPrior
from service.observations.field_faults import checked_by
from service.observations.schema import NORM_TOLERANCE, BatchIn, checked_from_model

CARRIED_WITHIN_S = 10.0
"""Greatest age in seconds of rates, velocity and position from another packet than the stars'."""

STATE_FIELDS = {
    "rates": "body_rates_deg_per_s",
    "velocity": "velocity_km_per_s",
    "position": "position_km",
}
"""Tables of `[packets]` for the spacecraft's state, and the batch fields that they fill."""
SCALES = {"rad_per_s": 180.0 / math.pi, "m_per_s": 1e-3, "m": 1e-3}
"""Factors from a unit to deg/s, km/s or km; 1 for units not listed."""

Values = Mapping[str, Any]


@dataclass
class StarBatch:
    """An unfinished batch of stars, with its first packet."""

    packet: SpacePacket
    moment: clock.Moment
    body: dict[str, Any]
    columns: list[TrackerColumns] = field(default_factory=list)
    slots: list[list[int]] = field(default_factory=list)
    """Indices of the packet slots that hold each tracker's stars."""

    def has_stars(self) -> bool:
        """True if any tracker has a star in the batch."""
        return any(self.slots)


@dataclass(frozen=True, slots=True)
class PacketAttitude:
    """A priori attitude read from a packet: scalar-last quaternion, inertial to body, and time."""

    moment: clock.Moment
    quaternion: tuple[float, float, float, float]


def quaternion_in(
    values: Mapping[str, Any], names: Sequence[str], table: PacketPrior | PacketMeasurement
) -> tuple[float, float, float, float] | None:
    """Quaternion read from a packet; None (no attitude) if it is zero or not finite.

    Raises `PacketFault` for a norm other than 1.
    """
    numbers = [clock.number(values, name) for name in names]
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
    """Change of a counter that wraps after `turn` counts, taken as the one nearest to zero."""
    half = turn // 2
    return (counts + half) % turn - half


class GyroRates:
    """Conversion of a gyro's counts in packets to body rates."""

    def __init__(self, gyro: PacketGyro, names: Sequence[str]) -> None:
        self._gyro = gyro
        self._names = names
        self._turn = 1 << gyro.counter_bits
        self._last: tuple[int, tuple[int, ...]] | None = None
        self._rates: list[float] | None = None

    def add(self, values: Mapping[str, Any], moment: clock.Moment) -> list[float] | None:
        """Body rates in deg/s at a packet; None if its angle has no recent predecessor."""
        gyro = self._gyro
        if gyro.kind == "rate":
            counts = clock.finite_all(values, self._names)
            return [count * scale for count, scale in zip(counts, gyro.scale_deg, strict=True)]
        angles = tuple(clock.whole(values, name) for name in self._names)
        before, self._last = self._last, (moment.tai_ns, angles)
        if self._last == before:
            # The packet was sent or stored twice, or several packets have one sample.
            return self._rates
        self._rates = None
        if before is None:
            return None
        passed_s = (moment.tai_ns - before[0]) / clock.NS
        if 0.0 < passed_s <= gyro.max_gap_s:
            self._rates = [
                counted_change(now - then, self._turn) * scale / passed_s
                for now, then, scale in zip(angles, before[1], gyro.scale_deg, strict=True)
            ]
        return self._rates


class Held:
    """Latest packet values of a quantity, with their time."""

    def __init__(self, within_s: float) -> None:
        self._within_ns = round(within_s * clock.NS)
        self._moment: clock.Moment | None = None
        self._values: list[float] | None = None

    def hold(self, moment: clock.Moment, values: list[float] | None) -> None:
        """Replace the held values and their time; values None: the packet has none."""
        self._moment, self._values = moment, values

    def near(self, moment: clock.Moment) -> list[float] | None:
        """Held values, if their time is near enough to `moment`; otherwise None."""
        if self._moment is None or abs(self._moment.tai_ns - moment.tai_ns) > self._within_ns:
            return None
        return self._values


class BatchMaker:
    """Converts packet values of one spacecraft, in order, to batches of stars."""

    def __init__(self, spacecraft: str, mapped: PacketMap) -> None:
        self._spacecraft = spacecraft
        self._mapped = mapped
        table = self._table = mapped.table
        self._prior = table.prior
        self._gyro = GyroRates(table.gyro, mapped.gyro) if table.gyro else None
        self._attitude = Held(table.prior.max_age_s if table.prior else 0.0)
        self._state = {name: Held(CARRIED_WITHIN_S) for name in STATE_FIELDS}
        self._pending: StarBatch | None = None
        self.without_attitude = 0
        """Number of packets whose a priori quaternion was zero or not finite."""

    def attitude(self, values: Values) -> PacketAttitude | None:
        """A priori attitude in a packet, None without a usable one; raises `PacketFault`."""
        names, prior = self._mapped.quaternion, self._prior
        if not names or prior is None or names[0] not in values:
            return None
        quaternion = quaternion_in(values, names, prior)
        if quaternion is None:
            self.without_attitude += 1
            return None
        return PacketAttitude(clock.moment_of(prior.time or self._table.time, values), quaternion)

    def add(self, packet: SpacePacket, values: Values) -> Iterator[StarBatch]:
        """Add a packet; yields the batch that the packet completes.  Raises `PacketFault`."""
        attitude = self.attitude(values)
        if attitude is not None:
            self._attitude.hold(attitude.moment, list(attitude.quaternion))
        mapped = self._mapped
        trackers = [each for each in mapped.trackers if each.first in values]
        state = (mapped.rates, mapped.gyro, mapped.velocity, mapped.position)
        if not trackers and not any(names and names[0] in values for names in state):
            return
        moment = clock.moment_of(self._table.time, values)
        self._hold_state(values, moment)
        if not trackers:
            return
        stars = [self._stars(each, values) for each in trackers]
        pending = self._pending
        if pending is not None and not self._joins(pending, moment, trackers):
            self._pending = None
            yield pending
            pending = None
        if pending is None:
            pending = self._pending = self._begun(packet, values, moment)
        later_s = (moment.tai_ns - pending.moment.tai_ns) / clock.NS
        for columns, (slots, seen) in zip(trackers, stars, strict=True):
            _shift(seen, later_s)
            pending.columns.append(columns)
            pending.slots.append(slots)
            pending.body["observations"].append({"tracker": columns.tracker, "stars": seen})
        if self._table.join_within_s == 0.0:
            self._pending = None
            yield pending

    def rates_near(self, moment: clock.Moment) -> list[float] | None:
        """Body rates in deg/s of a packet read so far, near enough to a moment; otherwise None."""
        return self._state["rates"].near(moment)

    def end(self) -> Iterator[StarBatch]:
        """Yield the unfinished batch, which waited for further trackers."""
        pending, self._pending = self._pending, None
        if pending is not None:
            yield pending

    def _hold_state(self, values: Values, moment: clock.Moment) -> None:
        mapped = self._mapped
        for name, held in self._state.items():
            if (names := getattr(mapped, name)) and names[0] in values:
                scale = SCALES.get(getattr(self._table, name).unit, 1.0)
                held.hold(moment, clock.finite_all(values, names, scale))
            if name == "rates" and self._gyro is not None and mapped.gyro[0] in values:
                held.hold(moment, self._gyro.add(values, moment))

    def _joins(
        self, pending: StarBatch, moment: clock.Moment, trackers: list[TrackerColumns]
    ) -> bool:
        apart_ns = abs(moment.tai_ns - pending.moment.tai_ns)
        held = {each.tracker for each in pending.columns}
        return apart_ns <= self._table.join_within_s * clock.NS and not any(
            each.tracker in held for each in trackers
        )

    def _begun(self, packet: SpacePacket, values: Values, moment: clock.Moment) -> StarBatch:
        table = self._table
        name = (
            clock.text(values, table.batch)
            if table.batch
            else f"{packet.apid}-{moment.text}-{packet.sequence_count}"
        )
        body: dict[str, Any] = {
            "spacecraft": self._spacecraft,
            "batch": name,
            "time": moment.text,
            "a_priori": self._a_priori(moment),
            "aberration": table.aberration,
            "observations": [],
        }
        for name, field_name in STATE_FIELDS.items():
            if (value := self._state[name].near(moment)) is not None:
                body[field_name] = value
        return StarBatch(packet, moment, body)

    def _a_priori(self, moment: clock.Moment) -> dict[str, Any] | None:
        if self._prior is None:
            return None
        if self._prior.sun_pointed:
            return {"sun_pointed": True, "frame": self._prior.frame}
        quaternion = self._attitude.near(moment)
        if quaternion is None:
            return None
        return {"quaternion": quaternion, "frame": self._prior.frame}

    def _stars(
        self, columns: TrackerColumns, values: Values
    ) -> tuple[list[int], list[dict[str, Any]]]:
        """Indices of a tracker's slots that hold a star, and these stars as JSON objects."""
        used = columns.slots
        if columns.count is not None:
            used = clock.whole(values, columns.count)
            if not 0 <= used <= columns.slots:
                message = f"must be from 0 to {columns.slots}, the number of slots"
                raise PacketFault(columns.count, message, used)
        slots, stars = [], []
        for slot in range(used):
            if columns.valid is not None and not clock.flag(
                values, columns.valid[slot], columns.valid_labels
            ):
                continue
            direction = [clock.number(values, each[slot]) for each in columns.directions]
            if not all(map(math.isfinite, direction)):
                continue
            star: dict[str, Any]
            if len(direction) == 3:
                star = {"vector": direction}
            else:
                star = {
                    "h_deg": direction[0] * columns.scale,
                    "v_deg": direction[1] * columns.scale,
                }
            if columns.magnitude is not None:
                magnitude = clock.number(values, columns.magnitude[slot])
                if not math.isnan(magnitude):
                    star["magnitude"] = magnitude
            if columns.time_offset_s is not None:
                star["time_offset_s"] = clock.finite(values, columns.time_offset_s[slot])
            if columns.sigma_arcsec is not None:
                sigma = clock.number(values, columns.sigma_arcsec[slot])
                if not math.isnan(sigma):
                    star["sigma_arcsec"] = sigma
            slots.append(slot)
            stars.append(star)
        return slots, stars

    def json_of(self, batch: StarBatch) -> bytes:
        """Canonical JSON of a batch; raises `PacketFault` naming the packet parameter at fault."""
        return _json_of(batch.body, lambda fault: self._parameter_of(batch, fault))

    def _parameter_of(self, batch: StarBatch, fault: Fault) -> str:
        """Packet parameters from which a field of a batch was made, for error messages."""
        head, *rest = fault.field.split(".")
        mapped = self._mapped
        whole_fields = {
            "batch": (mapped.table.batch or "",),
            "time": clock.names_of(mapped.table.time),
            "a_priori": mapped.quaternion,
            **{field: getattr(mapped, name) for name, field in STATE_FIELDS.items()},
            "body_rates_deg_per_s": mapped.rates or mapped.gyro,
        }
        if head != "observations":
            return ", ".join(whole_fields.get(head, ()))
        if len(rest) < 3 or not (rest[0].isdigit() and rest[2].isdigit()):
            return ", ".join(each.first for each in batch.columns)
        columns = batch.columns[int(rest[0])]
        slot = batch.slots[int(rest[0])][int(rest[2])]
        word = rest[3] if len(rest) > 3 else ""
        directions = tuple(each[slot] for each in columns.directions)
        if word in ("h_deg", "v_deg"):
            return directions[("h_deg", "v_deg").index(word)]
        if word in ("magnitude", "time_offset_s", "sigma_arcsec"):
            names: tuple[str, ...] = getattr(columns, word) or directions
            return names[slot] if names is not directions else ", ".join(directions)
        return ", ".join(directions)


def _json_of(body: dict[str, Any] | None, parameters_of: Callable[[Fault], str]) -> bytes:
    """Canonical JSON of a request body, after the checks of every batch."""
    try:
        model = checked_by(BatchIn.model_validate, body)
    except BadBatch as error:
        fault = error.faults[0]
        message = f"{fault.field}: {fault.message}"
        raise PacketFault(parameters_of(fault), message, fault.value) from None
    return checked_from_model(model).text.encode()


def _shift(stars: list[dict[str, Any]], later_s: float) -> None:
    """Shift the time offsets of stars from a packet later than the batch's first one."""
    if later_s:
        for star in stars:
            star["time_offset_s"] = star.get("time_offset_s", 0.0) + later_s


@dataclass(frozen=True)
class MeasuredBatch:
    """Batch of a measured attitude in a packet; `body` is None if the packet flags it invalid."""

    packet: SpacePacket
    columns: MeasurementColumns
    body: dict[str, Any] | None


class MeasurementMaker:
    """Converts packet values of one spacecraft to batches of measured attitudes.

    `rates_near` gives the body rates in deg/s at a moment: without them nothing tells how far the
    body turned between two attitudes.
    """

    def __init__(
        self,
        spacecraft: str,
        mapped: PacketMap,
        rates_near: Callable[[clock.Moment], list[float] | None],
    ) -> None:
        self._spacecraft = spacecraft
        self._mapped = mapped
        self._rates_near = rates_near

    def add(self, packet: SpacePacket, values: Mapping[str, Any]) -> Iterator[MeasuredBatch]:
        """Yield the measured attitudes in a packet; raises `PacketFault`."""
        for columns in self._mapped.measurements:
            if columns.quaternion[0] in values:
                yield MeasuredBatch(packet, columns, self._body(columns, packet, values))

    def json_of(self, batch: MeasuredBatch) -> bytes:
        """Canonical JSON of a batch; raises `PacketFault` naming the packet parameters at fault."""
        return _json_of(batch.body, lambda fault: self._parameters_of(batch.columns, fault))

    def _parameters_of(self, columns: MeasurementColumns, fault: Fault) -> str:
        names = columns.quaternion
        if fault.field.startswith(("measurement.sigma", "measurement.covariance")):
            names = columns.sigma or columns.covariance or names
        elif fault.field == "time":
            names = clock.names_of(columns.table.time or self._mapped.table.time)
        elif fault.field.startswith("body_rates_deg_per_s"):
            names = self._mapped.rates or self._mapped.gyro
        return ", ".join(names)

    def _body(
        self, columns: MeasurementColumns, packet: SpacePacket, values: Mapping[str, Any]
    ) -> dict[str, Any] | None:
        table = columns.table
        if table.valid is not None and not clock.flag(values, table.valid, columns.valid_labels):
            return None
        quaternion = quaternion_in(values, columns.quaternion, table)
        if quaternion is None:
            return None
        moment = clock.moment_of(table.time or self._mapped.table.time, values)
        measured: dict[str, Any] = {"quaternion": quaternion, "frame": table.frame}
        if table.tracker is not None:
            measured["tracker"] = table.tracker
        if columns.covariance:
            scale = columns.arcsec**2
            p11, p12, p13, p22, p23, p33 = clock.finite_all(values, columns.covariance, scale)
            rows = [[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]]
            measured["covariance_arcsec2"] = rows
        else:
            measured["sigma_arcsec"] = table.sigma_arcsec or clock.finite_all(
                values, columns.sigma, columns.arcsec
            )
        axes = table.tracker or "body"
        body: dict[str, Any] = {
            "spacecraft": self._spacecraft,
            "batch": f"{packet.apid}-{moment.text}-{packet.sequence_count}-{axes}",
            "time": moment.text,
            "a_priori": None,
            "measurement": measured,
        }
        if (rates := self._rates_near(moment)) is not None:
            body["body_rates_deg_per_s"] = rates
        return body
