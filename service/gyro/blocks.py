"""Gyro blocks: rates about three axes at rising times, as JSON and in compressed form."""

import hashlib
import math
import zlib
from dataclasses import dataclass
from typing import Annotated, Self

import msgspec
import numpy as np
import numpy.typing as npt
from erfa import ufunc
from pydantic import AfterValidator, Field, model_validator

from service.errors import BadBatch, Conflict, Fault, shown_value
from service.observations.field_faults import checked_by
from service.observations.schema import LIVE, Key, Number, RunName, Wire, is_time
from service.times import DAY_S, Utc, parse_utc, shifted
from service.vectors import Vector, read_only

Nanoseconds = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class GyroBlock:
    """A checked gyro block: its samples, and the names of spacecraft, run and block.

    `rates_rad_per_s` has the shape (n, 3), in the gyro axes that the mission defines; `times_s` has
    the shape (n,), in seconds of TAI after `start`, which is the time of the first sample. `step_s`
    is the constant interval if the block was sent with one, else None.
    """

    spacecraft: str
    run: str
    block: str
    start: Utc
    step_s: float | None
    times_s: Vector
    rates_rad_per_s: Vector

    @property
    def tai_ns(self) -> Nanoseconds:
        """The times of the samples in nanoseconds, as `Utc.tai_ns`."""
        return tai_ns_of(self.start.tai_ns, self.times_s)

    @property
    def end(self) -> Utc:
        """The time of the last sample."""
        return shifted(self.start, float(self.times_s[-1]))

    @property
    def fingerprint(self) -> str:
        """A digest of a gyro block's content, from its names, times and rates.

        White space, the order of keys and the format of times do not change it.
        """
        digest = hashlib.sha256()
        for text in (self.spacecraft, self.run, self.block, self.start.text, repr(self.step_s)):
            digest.update(text.encode() + b"\0")
        for values in (self.times_s, self.rates_rad_per_s):
            digest.update(np.ascontiguousarray(values, "<f8").tobytes())
        return digest.hexdigest()


def times_of_steps(step_s: float, samples: int) -> Vector:
    """The times of samples at a constant step, in seconds from the first sample."""
    return np.arange(samples, dtype=np.float64) * step_s


def texts_of(start: Utc, times_s: Vector) -> list[str]:
    """The UTC texts, in the format of `Utc.text`, of times in seconds of TAI after a start."""
    tai1, tai2, _ = ufunc.utctai(start.jd1, start.jd2)
    utc1, utc2, _ = ufunc.taiutc(tai1, tai2 + times_s / DAY_S)
    years, months, days, clocks, _ = ufunc.d2dtf(b"UTC", 9, utc1, utc2)
    fields = (years, months, days, *(clocks[name] for name in "hmsf"))
    return [
        f"{year:04d}-{month:02d}-{day:02d}T{h:02d}:{m:02d}:{s:02d}."
        f"{f'{f:09d}'.rstrip('0').ljust(3, '0')}Z"
        for year, month, day, h, m, s, f in zip(*(each.tolist() for each in fields), strict=True)
    ]


def tai_ns_of(start_ns: int, times_s: Vector) -> Nanoseconds:
    """Times in nanoseconds as `Utc.tai_ns`, from seconds after a start."""
    return start_ns + np.rint(times_s * 1e9).astype(np.int64)


SAME_TIME_NS = 1_000
"""Difference in nanoseconds below which two samples have the same time.

Times are sent as a rounded start plus accumulated steps, so that the same sample in two blocks may
differ by some nanoseconds.
"""


class SampleTaken(Conflict):
    """An error: a sample's time occurs in another block of the same spacecraft and run."""


def first_shared_ns(times_ns: Nanoseconds, others_ns: Nanoseconds) -> int | None:
    """The first of the times that also occurs in another block; None if none does; both sorted."""
    place = np.searchsorted(others_ns, times_ns)
    after = others_ns[np.minimum(place, others_ns.size - 1)]
    before = others_ns[np.maximum(place - 1, 0)]
    distance = np.minimum(np.abs(after - times_ns), np.abs(times_ns - before))
    shared = np.flatnonzero(distance < SAME_TIME_NS)
    return int(times_ns[shared[0]]) if shared.size else None


# Lossless compression of floating-point arrays to bytes, and back. A gyro counts, so that its rates
# have few different values: zlib finds repeated values and takes two bytes for most.

LEVEL = 1
"""Compression level of zlib; level 6 takes four times as long for about 2 % less."""


def pack(values: Vector) -> bytes:
    """An array of float64 as compressed bytes, column by column."""
    return zlib.compress(np.ascontiguousarray(values.T, "<f8").tobytes(), LEVEL)


def unpack(packed: bytes, shape: tuple[int, ...]) -> Vector:
    """The array of a given shape from compressed bytes, the reverse of `pack`.

    Raises `ValueError` for bytes that are damaged or hold another number of values.
    """
    try:
        columns = np.frombuffer(zlib.decompress(packed), "<f8")
    except zlib.error as error:
        raise ValueError(f"cannot be decompressed: {error}") from None
    if columns.size != np.prod(shape):
        raise ValueError(f"{columns.size} numbers are no {' x '.join(map(str, shape))}")
    return np.ascontiguousarray(columns.reshape(shape[::-1]).T)


# The JSON of a gyro block, checked field by field. The route and the readers of telemetry files
# read blocks with these models, so that they refuse the same errors with the same messages. The
# models also define `openapi.yaml`.

MAX_SAMPLES = 10_000
MIN_STEP_S = 1e-6
"""Least step in seconds, equal to `SAME_TIME_NS`: samples of one block have different times."""
MAX_SPAN_S = 86_400.0
"""Longest time from the first to the last sample of a block, in seconds."""

Offset = Annotated[Number, Field(ge=0, le=MAX_SPAN_S)]
Rates = tuple[Number, Number, Number]


class GyroBlockIn(Wire):
    """A block of gyro samples, in order of time."""

    block: Annotated[
        Key, Field(description="Names the block; unique for the spacecraft and the run.")
    ]
    start: Annotated[str, AfterValidator(is_time), Field(description="UTC of the first sample.")]
    run: RunName = LIVE
    step_s: Annotated[
        Annotated[Number, Field(ge=MIN_STEP_S, le=MAX_SPAN_S)] | None,
        Field(description="From each sample to the next; in place of `times_s`."),
    ] = None
    times_s: Annotated[
        Annotated[list[Offset], Field(min_length=1, max_length=MAX_SAMPLES)] | None,
        Field(
            description="Of each sample, in seconds of TAI after `start`; the first is 0. In place "
            "of `step_s`."
        ),
    ] = None
    rates_rad_per_s: Annotated[
        list[Rates],
        Field(
            min_length=1,
            max_length=MAX_SAMPLES,
            description="Of each sample: the rates about the three axes of the mission's gyro, of "
            "the body relative to inertial.",
        ),
    ]

    @model_validator(mode="after")
    def _one_kind_of_times(self) -> Self:
        if (self.step_s is None) == (self.times_s is None):
            raise ValueError("needs either step_s or times_s")
        return self


class GyroLineIn(GyroBlockIn):
    """A gyro block as a line of a telemetry file, which names the spacecraft."""

    spacecraft: Key


def block_from_json(body: bytes | str, spacecraft: str) -> GyroBlock:
    """A gyro block from a JSON body.

    Raises `BadBatch` with the faults, each naming field and value.
    """
    return block_from_model(checked_by(GyroBlockIn.model_validate_json, body), spacecraft)


def block_from_line(line: bytes | str, run: str | None = None) -> GyroBlock:
    """A gyro block from a line of a telemetry file; `run` overrides the block's own.

    Raises as `block_from_json` does.
    """
    model = checked_by(GyroLineIn.model_validate_json, line)
    return block_from_model(model, model.spacecraft, run)


class _Named(msgspec.Struct):
    """JSON with the one field that distinguishes a gyro block from a batch."""

    rates_rad_per_s: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET


_NAMED = msgspec.json.Decoder(_Named)


def is_gyro_line(line: bytes) -> bool:
    """True if a line of a telemetry file is a gyro block, not a batch."""
    # Most lines are batches, which need not be decoded for this test.
    if b'"rates_rad_per_s"' not in line:
        return False
    try:
        return _NAMED.decode(line).rates_rad_per_s is not msgspec.UNSET
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return False


def json_of_block(block: GyroBlock) -> bytes:
    """A gyro block as the JSON body of a request, the reverse of `block_from_json`."""
    times = (
        {"times_s": block.times_s.tolist()} if block.step_s is None else {"step_s": block.step_s}
    )
    fields = {"block": block.block, "start": block.start.text, "run": block.run}
    rates = {"rates_rad_per_s": block.rates_rad_per_s.tolist()}
    return msgspec.json.encode(fields | times | rates)


def block_from_model(model: GyroBlockIn, spacecraft: str, run: str | None = None) -> GyroBlock:
    """A gyro block from a validated model; raises `BadBatch` for invalid times."""
    rates = np.array(model.rates_rad_per_s, np.float64)
    if model.step_s is not None:
        times_s = times_of_steps(model.step_s, len(rates))
        if times_s[-1] > MAX_SPAN_S:
            message = f"{len(rates)} samples span {times_s[-1]:g} s, at most {MAX_SPAN_S:g} s may"
            raise BadBatch(Fault("step_s", message, shown_value(model.step_s)))
    else:
        times_s, rates = _once(np.array(model.times_s, np.float64), rates)
        _check_times(times_s, len(rates))
    return GyroBlock(
        spacecraft,
        run or model.run,
        model.block,
        parse_utc(model.start, "start"),
        model.step_s,
        read_only(times_s),
        read_only(rates),
    )


def _once(times_s: Vector, rates: Vector) -> tuple[Vector, Vector]:
    """Times and rates without exact repeats of the sample before; unequal numbers as they are."""
    if times_s.size != len(rates):
        return times_s, rates
    again = (np.diff(times_s) == 0.0) & (np.diff(rates, axis=0) == 0.0).all(axis=1)
    once = np.append(True, ~again)
    return times_s[once], rates[once]


def _check_times(times_s: Vector, samples: int) -> None:
    """Raise `BadBatch` unless there is one time per sample, rising from zero."""
    if times_s.size != samples:
        message = f"has {times_s.size} times for the {samples} samples of rates_rad_per_s"
        raise BadBatch(Fault("times_s", message))
    if times_s[0] != 0.0:
        message = "must be 0: start is the time of the first sample"
        raise BadBatch(Fault("times_s.0", message, shown_value(float(times_s[0]))))
    (early,) = np.nonzero(np.diff(tai_ns_of(0, times_s)) < SAME_TIME_NS)
    if early.size:
        k = int(early[0]) + 1
        before = float(times_s[k - 1])
        message = f"must be at least {MIN_STEP_S:g} s after the time before it, {before:g}"
        raise BadBatch(Fault(f"times_s.{k}", message, shown_value(float(times_s[k]))))


def require_rates_within(block: GyroBlock, largest_deg_per_s: float) -> None:
    """Raise `BadBatch` for a rate above the largest that the mission allows."""
    largest = math.radians(largest_deg_per_s)
    beyond = np.argwhere(np.abs(block.rates_rad_per_s) > largest)
    if beyond.size:
        sample, axis = map(int, beyond[0])
        message = (
            f"is beyond the largest rate of {block.spacecraft}, {largest:.6g} rad/s "
            f"({largest_deg_per_s:g} deg/s); is it in another unit than rad/s?"
        )
        raise BadBatch(
            Fault(
                f"rates_rad_per_s.{sample}.{axis}",
                message,
                shown_value(float(block.rates_rad_per_s[sample, axis])),
            )
        )
