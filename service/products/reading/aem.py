"""Reads AEM versions 1 and 2 (CCSDS 504.0-B), KVN and XML: quaternions of a spacecraft's body.

Version 1 says by ATTITUDE_DIR and QUATERNION_TYPE which way a quaternion transforms and where
its scalar stands; in version 2 it transforms from REF_FRAME_A to REF_FRAME_B and has the scalar
last, and a file that has either keyword is refused.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

import numpy as np

from service.observations.schema import NORM_TOLERANCE
from service.products.reading import tokens as ccsds
from service.products.reading.known import KnownAttitudes, Segment, known_attitudes

_BODY = re.compile(r"(SC_BODY|SPACECRAFT_BODY|SC_BODY_\w+)")
_V1_ONLY = {"QUATERNION_TYPE": ("FIRST", "LAST"), "ATTITUDE_DIR": ("A2B", "B2A")}
_NUMBERS = {
    1: {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/RATE": 7},
    2: {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/ANGVEL": 7},
}
"""The types that are read, by version, with the numbers of a state: the quaternion comes first."""
_NAMES = ("EPOCH", "Q1", "Q2", "Q3", "QC")
"""The names of the elements of an XML state."""
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
    "RATE_FRAME",
    "ANGVEL_FRAME",
    "INTERPOLATION_METHOD",
    "INTERPOLATION_DEGREE",
)


@dataclass(frozen=True)
class _Form:
    """How the states of a segment are read."""

    line: int
    time_system: str
    numbers: int
    scalar_first: bool
    is_inverse: bool
    useable_ns: tuple[int | None, int | None]


def read_aem(name: str, file: IO[bytes]) -> KnownAttitudes:
    """The attitudes of a message; raises `BadFile` naming file, line and field."""
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
        numbers = _NUMBERS[self._version]
        type = metadata.one_of("ATTITUDE_TYPE", tuple(numbers))
        if self._version == 1:
            metadata.require(tuple(_V1_ONLY))
        time_system = metadata.time_system()
        metadata.span(time_system)
        self._check_object(metadata)
        return _Form(
            line=metadata.line,
            time_system=time_system,
            numbers=numbers[type],
            scalar_first=self._v1_keyword(metadata, "QUATERNION_TYPE") == "FIRST",
            is_inverse=self._from_body(metadata)
            != (self._v1_keyword(metadata, "ATTITUDE_DIR") == "B2A"),
            useable_ns=metadata.useable(time_system),
        )

    def _v1_keyword(self, metadata: ccsds.Metadata, name: str) -> str:
        return metadata.one_of(name, _V1_ONLY[name]) if self._version == 1 else ""

    def _from_body(self, metadata: ccsds.Metadata) -> bool:
        """True if REF_FRAME_A is the body; the other frame must be inertial."""
        frames = {name: metadata.values[name].upper() for name in ("REF_FRAME_A", "REF_FRAME_B")}
        is_body = {name: bool(_BODY.fullmatch(frame)) for name, frame in frames.items()}
        for name, frame in frames.items():
            if not is_body[name] and frame not in ccsds.INERTIAL:
                message = f"must be one of {', '.join(ccsds.INERTIAL)}, or the body as SC_BODY_1"
                raise metadata.fault(name, message)
        if is_body["REF_FRAME_A"] == is_body["REF_FRAME_B"]:
            message = "one of REF_FRAME_A and REF_FRAME_B must be inertial, the other the body"
            raise metadata.fault("REF_FRAME_B", message)
        return is_body["REF_FRAME_A"]

    def _state(self, token: ccsds.Token, form: _Form) -> tuple[int, tuple[float, ...]]:
        words = token.words if token.names is None else self._source.named(token, _NAMES)
        if token.names is None and len(words) != 1 + form.numbers:
            message = f"must have an epoch and {form.numbers} numbers"
            raise self._source.bad(token.line, "state", message, " ".join(words))
        time_ns = self._source.epoch_ns(token, words[0], form.time_system)
        numbers = [self._source.number(token, word) for word in words[1:]]
        quaternion = numbers[:4]
        if form.scalar_first and token.names is None:
            quaternion = [*numbers[1:4], numbers[0]]
        norm = math.hypot(*quaternion)
        if not abs(norm - 1.0) <= NORM_TOLERANCE:
            message = f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}"
            raise self._source.bad(token.line, "quaternion", message, quaternion)
        return time_ns, tuple(quaternion)

    def _made(self, form: _Form, times: list[int], numbers: list[tuple[float, ...]]) -> Segment:
        time_ns = np.array(times, dtype=np.int64)
        quaternion = np.array(numbers)
        quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
        if form.is_inverse:
            quaternion[:, :3] *= -1.0
        span = ccsds.useable_span(times, form.useable_ns)
        return Segment(f"line {form.line}", time_ns, *span, quaternion)


def _epoch(token: ccsds.Token) -> str:
    if token.names is None:
        return token.words[0]
    return dict(zip(token.names, token.words, strict=True)).get("EPOCH", "")
