"""Reader of AEM versions 1 and 2 (CCSDS 504.0-B), KVN and XML: attitudes of a spacecraft body.

Quaternions, Euler angles and spin, with their rates: see `attitude_types`.

In version 1 ATTITUDE_DIR and QUATERNION_TYPE give the direction of a quaternion and the place of
its scalar; in version 2 quaternions are from REF_FRAME_A to REF_FRAME_B with the scalar last, and a
file with either keyword is refused.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

import numpy as np

from service.ephemerides import tokens as ccsds
from service.ephemerides.attitude_types import (
    AttitudeType,
    Frames,
    body_attitudes,
)
from service.ephemerides.known import KnownAttitudes, Segment, known_attitudes, told_rates
from service.observations.schema import NORM_TOLERANCE

_V1_ONLY = {"QUATERNION_TYPE": ("FIRST", "LAST"), "ATTITUDE_DIR": ("A2B", "B2A")}
_TYPES = {
    "QUATERNION": AttitudeType("quaternion"),
    "QUATERNION/DERIVATIVE": AttitudeType("quaternion", "q_dot"),
    "QUATERNION/RATE": AttitudeType("quaternion", "euler"),
    "QUATERNION/ANGVEL": AttitudeType("quaternion", "angvel"),
    "EULER_ANGLE": AttitudeType("euler"),
    "EULER_ANGLE/RATE": AttitudeType("euler", "euler"),
    "EULER_ANGLE/DERIVATIVE": AttitudeType("euler", "euler"),
    "EULER_ANGLE/ANGVEL": AttitudeType("euler", "angvel"),
    "SPIN": AttitudeType("spin", "spin"),
    "SPIN/NUTATION": AttitudeType("spin", "nutation"),
    "SPIN/NUTATION_MOM": AttitudeType("spin", "momentum"),
}
"""Attitude types of AEM, which files of either version mix: /RATE is of version 1, /DERIVATIVE of
Euler angles, /ANGVEL and /NUTATION_MOM are of version 2.
"""
_UNITS = {
    "EPOCH": "",
    "RATE": "deg/s",
    "VEL": "deg/s",
    "ANGVEL": "deg/s",
    "DOT": "deg/s",
    "PER": "s",
}
"""Unit of an XML element, by a part of its name; all others are in degrees."""
_RATE_FRAMES = ("RATE_FRAME", "ANGVEL_FRAME")
_HEADER = ("CREATION_DATE", "ORIGINATOR", "MESSAGE_ID", "CLASSIFICATION")
_REQUIRED = (
    "OBJECT_NAME",
    "OBJECT_ID",
    "REF_FRAME_A",
    "REF_FRAME_B",
    "TIME_SYSTEM",
    "START_TIME",
    "STOP_TIME",
    "ATTITUDE_TYPE",
)
_METADATA = (
    *_REQUIRED,
    *_V1_ONLY,
    "CENTER_NAME",
    "USEABLE_START_TIME",
    "USEABLE_STOP_TIME",
    "EULER_ROT_SEQ",
    *_RATE_FRAMES,
    "INTERPOLATION_METHOD",
    "INTERPOLATION_DEGREE",
)


@dataclass(frozen=True)
class _Form:
    """Layout of a segment's states: time system, attitude type, frames, place of the scalar."""

    line: int
    time_system: str
    type: AttitudeType
    frames: Frames
    scalar_first: bool
    useable_ns: tuple[int | None, int | None]


def read_aem(name: str, file: IO[bytes]) -> KnownAttitudes:
    """Read the attitudes of an AEM message; raises `BadFile` naming file, line and field."""
    return _Reader(ccsds.Source(name)).read(file)


class _Reader(ccsds.MessageReader):
    _version = 0

    def read(self, file: IO[bytes]) -> KnownAttitudes:
        tokens = ccsds.tokens_of(self._source, file, ccsds.AEM)
        version = ccsds.read_version(self._source, next(tokens, None), ccsds.AEM, ("1.0", "2.0"))
        self._version = int(version[0])
        segments: list[Segment] = []
        last = 1
        for token in tokens:
            last = token.line
            if token.kind == "key" and token.name in _HEADER and not segments:
                continue
            if token.name != "META_START":
                raise self._source.bad_token(token, "is out of place: META_START is expected")
            segments.append(self._segment(tokens, token.line))
        if not segments:
            raise self._source.bad(last, "META_START", "is missing: the message has no segment")
        return known_attitudes(self._source.name, self._object_name, segments)

    def _segment(self, tokens: Iterator[ccsds.Token], line: int) -> Segment:
        form = self._form(self._metadata(tokens, line))
        start = next(tokens, None)
        if start is None or start.name != "DATA_START":
            found = form.line if start is None else start.line
            raise self._source.bad(found, "DATA_START", "must follow META_STOP")
        times: list[int] = []
        numbers: list[tuple[float, ...]] = []
        for token in tokens:
            if token.name == "DATA_STOP":
                if not times:
                    raise self._source.bad(token.line, "DATA_STOP", "ends a segment of no state")
                return self._made(form, times, numbers)
            if token.kind != "state":
                raise self._source.bad_token(
                    token, "is out of place between DATA_START and DATA_STOP"
                )
            time_ns, quaternion = self._state(token, form)
            self._count_state(token, _epoch(token), time_ns, times)
            times.append(time_ns)
            numbers.append(quaternion)
        raise self._source.bad(form.line, "DATA_STOP", "is missing: the file was cut short")

    def _metadata(self, tokens: Iterator[ccsds.Token], line: int) -> ccsds.Metadata:
        found = ccsds.read_metadata(self._source, tokens, line, _METADATA, ccsds.AEM)
        for name in found.values:
            if self._version > 1 and name in _V1_ONLY:
                raise found.fault(
                    name,
                    "is of version 1: in version 2 quaternions have the scalar last and transform "
                    "from REF_FRAME_A to REF_FRAME_B",
                )
        return found

    def _form(self, metadata: ccsds.Metadata) -> _Form:
        metadata.require(_REQUIRED)
        type = _TYPES[metadata.one_of("ATTITUDE_TYPE", tuple(_TYPES))]
        if self._version == 1:
            metadata.require(("ATTITUDE_DIR",))
            if type.attitude == "quaternion":
                metadata.require(("QUATERNION_TYPE",))
        time_system = metadata.time_system()
        metadata.span(time_system)
        self._check_object(metadata)
        sequence = self._sequence(metadata, type)
        if type.rates == "euler" and not sequence:
            # Without a sequence the rates of version 1 can only be an angular velocity.
            type = AttitudeType(type.attitude, "angvel")
        from_body = ccsds.from_body(metadata)
        reverse = self._v1_keyword(metadata, "ATTITUDE_DIR") == "B2A"
        return _Form(
            line=metadata.line,
            time_system=time_system,
            type=type,
            frames=Frames(
                sequence, from_body, from_body != reverse, self._rate_in_body(metadata, from_body)
            ),
            scalar_first=type.attitude == "quaternion"
            and self._v1_keyword(metadata, "QUATERNION_TYPE") == "FIRST",
            useable_ns=metadata.useable(time_system),
        )

    def _sequence(self, metadata: ccsds.Metadata, type: AttitudeType) -> str:
        """Axes of the Euler angles in a segment, such as ZXZ; empty if its states have none."""
        if type.attitude != "euler" and "EULER_ROT_SEQ" not in metadata.values:
            return ""
        return ccsds.euler_sequence(metadata) if "euler" in (type.attitude, type.rates) else ""

    def _rate_in_body(self, metadata: ccsds.Metadata, from_body: bool) -> bool:
        """True if a segment's angular velocity has components about the body's axes."""
        name = next((each for each in _RATE_FRAMES if each in metadata.values), None)
        if name is None:
            return True
        frames = [metadata.values[key].upper() for key in ("REF_FRAME_A", "REF_FRAME_B")]
        value = metadata.values[name].upper()
        if value in ("REF_FRAME_A", frames[0]):
            return from_body
        if value in ("REF_FRAME_B", frames[1]):
            return not from_body
        raise metadata.fault(name, f"must be one of {', '.join(frames)}")

    def _v1_keyword(self, metadata: ccsds.Metadata, name: str) -> str:
        if self._version > 1 or name not in metadata.values:
            return ""
        return metadata.one_of(name, _V1_ONLY[name])

    def _state(self, token: ccsds.Token, form: _Form) -> tuple[int, tuple[float, ...]]:
        words = token.words if token.names is None else self._named(token, form)
        if token.names is None and len(words) != 1 + form.type.size:
            message = f"must have an epoch and {form.type.size} numbers"
            raise self._source.bad(token.line, "state", message, " ".join(words))
        time_ns = self._source.epoch_ns(token, words[0], form.time_system)
        numbers = [self._source.number(token, word) for word in words[1:]]
        if form.scalar_first and token.names is None:
            numbers = _scalar_last(numbers)
        if form.type.attitude == "quaternion":
            norm = math.hypot(*numbers[:4])
            if not abs(norm - 1.0) <= NORM_TOLERANCE:
                message = f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}"
                raise self._source.bad(token.line, "quaternion", message, numbers[:4])
        if form.type.rates == "nutation" and numbers[5] == 0.0:
            raise self._source.bad(token.line, "NUTATION_PER", "must not be 0", numbers[5])
        return time_ns, tuple(numbers)

    def _named(self, token: ccsds.Token, form: _Form) -> tuple[str, ...]:
        """Values of a state in XML, brought into the order that a state in KVN has."""
        assert token.names is not None
        wanted = [("EPOCH",), *form.type.names(form.frames.sequence)]
        for name in set(token.names):
            if token.names.count(name) > max(1, sum(name in each for each in wanted)):
                raise self._source.bad(token.line, name, "must be there once in a state")
        left = list(zip(token.names, token.words, token.units, strict=True))
        words = []
        for names in wanted:
            place = next((k for k, each in enumerate(left) if each[0] in names), None)
            if place is None:
                raise self._source.bad(token.line, names[0], "must be there once in a state")
            name, word, unit = left.pop(place)
            expected = _unit_of(name)
            if unit and unit.lower() != expected:
                raise self._source.bad(
                    token.line, name, f"must be in {expected or 'no unit'}", unit
                )
            words.append(word)
        return tuple(words)

    def _made(self, form: _Form, times: list[int], numbers: list[tuple[float, ...]]) -> Segment:
        time_ns = np.array(times, dtype=np.int64)
        quaternion, rate = body_attitudes(form.type, np.array(numbers), form.frames)
        span = ccsds.useable_span(times, form.useable_ns)
        rate = told_rates(quaternion, rate)
        return Segment(f"line {form.line}", time_ns, *span, quaternion, rate)


def _unit_of(name: str) -> str:
    """Unit of an XML element of a state by its name, such as deg/s; empty for a pure number."""
    if name.startswith("Q"):
        return "1/s" if name.endswith("_DOT") else ""
    return next((unit for end, unit in _UNITS.items() if end in name.split("_")), "deg")


def _scalar_last(numbers: list[float]) -> list[float]:
    """Move the scalar of a quaternion, and of its derivative if given, to the end."""
    parts = [numbers[first : first + 4] for first in range(0, len(numbers) - 3, 4)]
    turned = [each for part in parts for each in (*part[1:], part[0])]
    return turned + numbers[len(turned) :]


def _epoch(token: ccsds.Token) -> str:
    if token.names is None:
        return token.words[0]
    return dict(zip(token.names, token.words, strict=True)).get("EPOCH", "")
