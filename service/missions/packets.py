"""A mission's table `[packets]`: the telemetry parameters of CCSDS packets that fill a batch.

Parameters have the names of the mission's XTCE file. That file alone describes the position of a
parameter in a packet, its encoding and its calibration.
"""

import math
import re
from datetime import date, datetime
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from service.missions.strict import Strict

MOST_SLOTS = 250
SLOT_NUMBER = "{}"

ParameterName = Annotated[str, Field(pattern=r"^[^\s/:{}]{1,128}$")]
_SLOT_NAME = re.compile(r"[^\s/:{}]*\{\}[^\s/:{}]*|[^\s/:{}]+", re.ASCII)


def _slot_name(text: str) -> str:
    if len(text) > 128 or not _SLOT_NAME.fullmatch(text):
        raise ValueError("must name an XTCE array, or parameters as in ST_H_{}, with one {}")
    return text


SlotNames = (
    Annotated[str, AfterValidator(_slot_name)]
    | Annotated[tuple[ParameterName, ...], Field(min_length=1, max_length=MOST_SLOTS)]
)
"""The parameter names of a tracker's slots: an XTCE array, a pattern with `{}`, or a list."""
Triple = ParameterName | tuple[ParameterName, ParameterName, ParameterName]
Quadruple = ParameterName | tuple[ParameterName, ParameterName, ParameterName, ParameterName]
Upper = (
    ParameterName
    | tuple[
        ParameterName, ParameterName, ParameterName, ParameterName, ParameterName, ParameterName
    ]
)
"""The upper triangle of a symmetric matrix by rows, as parameters: 11, 12, 13, 22, 23, 33."""
ValidLabels = Annotated[tuple[str, ...], Field(min_length=1, max_length=100)] | None
_no_labels: Any = Field(default=None, exclude_if=lambda labels: labels is None)
"""Field without labels by default, which are then no part of the mission's digest."""
SigmaArcsec = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def element_names(names: str | tuple[str, ...], count: int, first: int = 0) -> tuple[str, ...]:
    """The XTCE names of `count` values: array elements, numbered names from `first`, or a list.

    An element of an array is written NAME[0], from 0 up, as in XTCE references.
    """
    if not isinstance(names, str):
        return names
    if SLOT_NUMBER in names:
        return tuple(names.replace(SLOT_NUMBER, str(first + index)) for index in range(count))
    return tuple(f"{names}[{index}]" for index in range(count))


class CdsTime(Strict):
    """CCSDS day segmented time: a day number, and milliseconds of the day in UTC.

    Day and milliseconds must be fields of one time: at midnight a day taken from another field
    of the packet is a day off.
    """

    kind: Literal["cds"]
    day: ParameterName
    millisecond: ParameterName
    microsecond: ParameterName | None = None
    """The parameter with the microseconds within the millisecond, if there is one."""
    epoch: date = date(1958, 1, 1)
    """The date of day number 0 in a CCSDS day segmented time."""


class CucTime(Strict):
    """CCSDS unsegmented time: seconds since an epoch, and a binary fraction of a second."""

    kind: Literal["cuc"]
    coarse: ParameterName
    fine: ParameterName | None = None
    fine_bits: int = Field(default=16, ge=1, le=64)
    """Number of bits of the fine time, which counts in units of 2^-fine_bits s."""
    epoch: datetime = datetime(1958, 1, 1)
    """The epoch from which the seconds count, on the clock of `scale`."""
    scale: Literal["tai", "gps", "utc"] = "tai"
    """Clock of the seconds; `tai` and `gps` count leap seconds, `utc` omits them as POSIX does."""

    @model_validator(mode="after")
    def _epoch_has_no_zone(self) -> Self:
        if self.epoch.tzinfo is not None or self.epoch.microsecond:
            raise ValueError("epoch must be whole seconds without a zone: 1980-01-06T00:00:00")
        return self


PacketTime = Annotated[CdsTime | CucTime, Field(discriminator="kind")]


class PacketTracker(Strict):
    """The parameters of one tracker's stars, in slots numbered from `first_slot`."""

    tracker: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")
    slots: int = Field(ge=1, le=MOST_SLOTS)
    first_slot: int = Field(default=1, ge=0, le=1000)
    """The number that replaces `{}` in the names of the first slot."""
    h: SlotNames | None = None
    v: SlotNames | None = None
    angle_unit: Literal["deg", "arcmin", "arcsec", "rad"] = "deg"
    """Unit of the angles h and v after the calibration described by the XTCE file."""
    vector: tuple[SlotNames, SlotNames, SlotNames] | None = None
    """Parameters of unit vectors in tracker axes, as an alternative to h and v."""
    magnitude: SlotNames | None = None
    time_offset_s: SlotNames | None = None
    sigma_arcsec: SlotNames | None = None
    count: ParameterName | None = None
    """The parameter with the number of slots, counted from the first, that hold a star."""
    valid: SlotNames | None = None
    """The parameters that are nonzero for slots that hold a star."""
    valid_labels: ValidLabels = _no_labels
    """The labels (or texts) of an enumerated parameter for which a slot holds a star."""

    @model_validator(mode="after")
    def _names_fit(self) -> Self:
        angles = (self.h is not None, self.v is not None)
        if self.vector is None and not all(angles):
            raise ValueError("needs either vector, or both h and v")
        if self.vector is not None and any(angles):
            raise ValueError("takes either vector, or h and v, not both")
        columns = {
            name: getattr(self, name)
            for name in ("h", "v", "magnitude", "time_offset_s", "sigma_arcsec", "valid")
        }
        columns |= {f"vector.{i}": names for i, names in enumerate(self.vector or ())}
        for name, names in columns.items():
            if isinstance(names, tuple) and len(names) != self.slots:
                raise ValueError(f"{name} names {len(names)} parameters for {self.slots} slots")
        return self


class PacketPrior(Strict):
    """The parameters of an a priori attitude: a quaternion in the stars' packet or another one."""

    quaternion: Quadruple | None = None
    scalar: Literal["last", "first"] = "last"
    direction: Literal["inertial_to_body", "body_to_inertial"] = "inertial_to_body"
    frame: Literal["EME2000", "ICRF", "GCRF"] = "EME2000"
    time: PacketTime | None = None
    """The parameters of the a priori attitude's own time; by default the time of its packet."""
    max_age_s: float = Field(default=10.0, gt=0, le=86400)
    """Largest time difference in seconds between stars and an attitude from another packet."""
    sun_pointed: bool = False
    """True if, without a quaternion, the mission's pole is always at the Sun, roll unknown."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.quaternion is not None) == self.sun_pointed:
            raise ValueError("needs either quaternion or sun_pointed = true")
        return self


class PacketMeasurement(Strict):
    """The parameters of an attitude measured by a tracker itself: a quaternion with its accuracy.

    Each packet with these parameters gives a batch of its own.
    """

    quaternion: Quadruple
    tracker: str | None = Field(default=None, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")
    """The tracker whose axes the attitude describes; None for the body's axes."""
    scalar: Literal["last", "first"] = "last"
    direction: Literal["inertial_to_body", "body_to_inertial"] = "inertial_to_body"
    """Direction of the quaternion's rotation; with `tracker`, its axes stand for the body's."""
    frame: Literal["EME2000", "ICRF", "GCRF"] = "EME2000"
    sigma: Triple | None = None
    """Parameters of one sigma of the rotation about each of the attitude's axes."""
    covariance: Upper | None = None
    """Parameters of the covariance about the attitude's axes, in place of the sigmas."""
    angle_unit: Literal["deg", "arcmin", "arcsec", "rad"] = "arcsec"
    """Unit of `sigma`; the unit of `covariance` is its square."""
    sigma_arcsec: tuple[SigmaArcsec, SigmaArcsec, SigmaArcsec] | None = None
    """Constant sigmas of the measured attitude in arcsec, in place of parameters."""
    valid: ParameterName | None = None
    """The parameter that is nonzero if the packet holds an attitude."""
    valid_labels: ValidLabels = _no_labels
    """The labels (or texts) of an enumerated parameter for which the packet holds an attitude."""
    time: PacketTime | None = None
    """The parameters of the measured attitude's own time; by default the time of its packet."""

    @model_validator(mode="after")
    def _one_accuracy(self) -> Self:
        accuracies = (self.sigma, self.covariance, self.sigma_arcsec)
        if sum(each is not None for each in accuracies) != 1:
            raise ValueError("needs one of sigma, covariance and sigma_arcsec")
        return self


class PacketRates(Strict):
    """The parameters of body rates, in body axes and relative to inertial space."""

    components: Triple
    unit: Literal["deg_per_s", "rad_per_s"] = "deg_per_s"


class PacketGyro(Strict):
    """The parameters of gyro counts about the body axes, as an alternative to body rates."""

    counts: Triple
    kind: Literal["angle", "rate"] = "angle"
    """Meaning of gyro counts: with `angle` an accumulating counter, whose change gives the rate."""
    scale_deg: tuple[float, float, float]
    """Factors (3,) from gyro counts to degrees about each axis; to deg/s for `rate`."""
    counter_bits: int = Field(default=16, ge=2, le=64)
    """Number of bits after which an accumulated angle overflows to zero."""
    max_gap_s: float = Field(default=10.0, gt=0, le=3600)
    """Largest interval between packets, in seconds, for which counter changes give a rate."""

    @model_validator(mode="after")
    def _scale_is_not_zero(self) -> Self:
        if any(scale == 0.0 or not math.isfinite(scale) for scale in self.scale_deg):
            raise ValueError("scale_deg must hold three numbers other than 0")
        return self


class PacketGyroBlocks(Strict):
    """Parameters of gyro samples, about the axes of the mission's gyro, recorded as gyro blocks."""

    samples: int = Field(default=1, ge=1, le=MOST_SLOTS)
    """Number of gyro samples in one packet, numbered from `first_sample`."""
    first_sample: int = Field(default=1, ge=0, le=1000)
    values: tuple[SlotNames, SlotNames, SlotNames]
    """Parameters of the gyro samples about each axis: arrays, patterns or lists."""
    kind: Literal["rate", "angle"] = "rate"
    """Meaning of gyro values: with `angle` an accumulating counter, whose change gives the rate."""
    scale_rad: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors (3,) from recorded gyro values to rad/s about each axis; to radians for `angle`."""
    counter_bits: int = Field(default=16, ge=2, le=64)
    """Number of bits after which an accumulated angle overflows to zero."""
    max_gap_s: float = Field(default=10.0, gt=0, le=3600)
    """Largest interval in seconds between accumulated angles that give a rate."""
    time: PacketTime | None = None
    """The time of the first gyro sample in a packet; by default the time of the packet."""
    step_s: float | None = Field(default=None, gt=0, le=3600)
    """Interval in seconds between the gyro samples of a packet."""
    time_offset_s: SlotNames | None = None
    """Offset in seconds of each gyro sample from the time, in place of a constant step."""
    count: ParameterName | None = None
    """The parameter with the number of gyro samples in the packet, counted from the first."""
    block_s: float = Field(default=600.0, ge=1, le=86400)
    """Length of gyro blocks in seconds of TAI, at fixed boundaries, so that the same samples give
    the same blocks from any file.
    """

    @model_validator(mode="after")
    def _samples_have_times(self) -> Self:
        if any(scale == 0.0 or not math.isfinite(scale) for scale in self.scale_rad):
            raise ValueError("scale_rad must hold three numbers other than 0")
        both = self.step_s is not None and self.time_offset_s is not None
        neither = self.step_s is None and self.time_offset_s is None
        if both or (neither and self.samples > 1):
            raise ValueError("needs either step_s or time_offset_s")
        columns = {f"values.{i}": names for i, names in enumerate(self.values)}
        if self.time_offset_s is not None:
            columns["time_offset_s"] = self.time_offset_s
        for name, names in columns.items():
            if isinstance(names, tuple) and len(names) != self.samples:
                raise ValueError(f"{name} names {len(names)} parameters for {self.samples} samples")
        return self


class PacketVelocity(Strict):
    """The parameters of the spacecraft's geocentric velocity, EME2000."""

    components: Triple
    unit: Literal["km_per_s", "m_per_s"] = "km_per_s"


class PacketPosition(Strict):
    """The parameters of the spacecraft's geocentric position, EME2000."""

    components: Triple
    unit: Literal["km", "m"] = "km"


class Packets(Strict):
    """The mapping of a mission's XTCE parameters to the fields of a batch.

    Each packet with the parameters of `time` and of a tracker gives a batch.
    """

    root_container: ParameterName = "CCSDSPacket"
    """The root container in the XTCE file, as which every packet is decoded."""
    prefix_bytes: int = Field(default=0, ge=0, le=4096)
    """Number of bytes before each packet in a file, which are skipped."""
    sequence_flags: Literal["segments", "groups"] = Field(
        default="segments", exclude_if=lambda meaning: meaning == "segments"
    )
    """Meaning of sequence flags: segments, which are joined, or groups of whole packets."""
    segment_header_bytes: int = Field(
        default=0, ge=0, le=4096, exclude_if=lambda length: length == 0
    )
    """Length of the repeated secondary header in later segments, which is skipped."""
    apids: tuple[Annotated[int, Field(ge=0, le=2047)], ...] = ()
    """The APIDs that are read, others are only counted; empty for all in the XTCE file."""
    time: PacketTime
    trackers: tuple[PacketTracker, ...] = Field(default=(), max_length=16)
    """The trackers' parameters; without them packets give only the data of the other tables."""
    measurements: tuple[PacketMeasurement, ...] = Field(
        default=(), max_length=16, exclude_if=lambda measurements: not measurements
    )
    """The parameters of measured attitudes; if missing, no part of the mission's digest."""
    join_within_s: float = Field(default=0.0, ge=0, le=60)
    """Largest time difference in seconds of packets from several trackers in one batch."""
    batch: ParameterName | None = None
    """The parameter that names a batch; by default APID, time and sequence count do."""
    prior: PacketPrior | None = None
    rates: PacketRates | None = None
    gyro: PacketGyro | None = None
    gyro_blocks: PacketGyroBlocks | None = Field(
        default=None, exclude_if=lambda blocks: blocks is None
    )
    """The parameters of gyro blocks; if missing, no part of the mission's digest."""
    velocity: PacketVelocity | None = None
    position: PacketPosition | None = None
    aberration: Literal["to_correct", "applied_upstream", "ignore"] = "to_correct"

    @model_validator(mode="after")
    def _say_each_thing_once(self) -> Self:
        if self.rates is not None and self.gyro is not None:
            raise ValueError("takes either rates or gyro, not both")
        has_quaternion = self.prior is not None and self.prior.quaternion is not None
        if not (self.trackers or has_quaternion or self.gyro_blocks or self.measurements):
            raise ValueError(
                "needs trackers, measurements, gyro_blocks, or a prior with a quaternion"
            )
        names = [each.tracker for each in self.trackers]
        if len(set(names)) != len(names):
            raise ValueError(f"a tracker occurs twice: {', '.join(names)}")
        measured = [each.tracker or "the body" for each in self.measurements]
        if len(set(measured)) != len(measured):
            raise ValueError(f"measurements has axes twice: {', '.join(measured)}")
        return self
