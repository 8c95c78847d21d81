"""Reads AEM versions 1 and 2 (CCSDS 504.0-B), KVN and XML: quaternions of a spacecraft's body.

Version 1 says by ATTITUDE_DIR and QUATERNION_TYPE which way a quaternion transforms and where
its scalar stands; in version 2 it transforms from REF_FRAME_A to REF_FRAME_B and has the scalar
last, and a file that has either keyword is refused.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO

import numpy as np

from service.observations.schema import NORM_TOLERANCE
from service.products.reading.epochs import TIME_SYSTEMS, epoch_ns
from service.products.reading.known_attitudes import (
    MOST_RECORDS,
    KnownAttitudes,
    Segment,
    known_attitudes,
)
from service.products.reading.tokens import Source, Token, tokens_of

INERTIAL = ("EME2000", "J2000", "ICRF", "GCRF")
"""One frame for the service, which lets 23 mas between EME2000 and ICRF be."""
_BODY = re.compile(r"(SC_BODY|SPACECRAFT_BODY|SC_BODY_\w+)")
_V1_ONLY = {"QUATERNION_TYPE": ("FIRST", "LAST"), "ATTITUDE_DIR": ("A2B", "B2A")}
_NUMBERS = {
    1: {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/RATE": 7},
    2: {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/ANGVEL": 7},
}
"""The types that are read, by version, with the numbers of a state: the quaternion comes first."""
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
_TIMES = ("START_TIME", "USEABLE_START_TIME", "USEABLE_STOP_TIME", "STOP_TIME")


@dataclass
class _Metadata:
    """The keywords of a segment, each with its line."""

    line: int
    values: dict[str, str] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)


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
    return _Reader(Source(name)).read(file)


class _Reader:
    def __init__(self, source: Source) -> None:
        self._source = source
        self._version = 0
        self._object: tuple[str, str] | None = None
        self._records = 0

    def read(self, file: IO[bytes]) -> KnownAttitudes:
        tokens = tokens_of(self._source, file, "AEM")
        self._read_version(next(tokens, None))
        segments: list[Segment] = []
        last = 1
        for token in tokens:
            last = token.line
            if token.kind == "key" and token.name in _HEADER and not segments:
                continue
            if token.name != "META_START":
                raise self._bad(token, "is out of place: META_START is expected")
            segments.append(self._segment(tokens, token.line))
        if not segments:
            raise self._source.bad(last, "META_START", "is missing: the message has no segment")
        assert self._object is not None
        return known_attitudes(self._source.name, self._object[0], segments)

    def _read_version(self, token: Token | None) -> None:
        if token is None or token.name != "CCSDS_AEM_VERS":
            line = 1 if token is None else token.line
            raise self._source.bad(line, "CCSDS_AEM_VERS", "must come first in a message")
        if token.value not in ("1.0", "2.0"):
            raise self._bad(token, "must be 1.0 or 2.0")
        self._version = int(token.value[0])

    def _segment(self, tokens: Iterator[Token], line: int) -> Segment:
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
                raise self._bad(token, "is out of place between DATA_START and DATA_STOP")
            time_ns, quaternion = self._state(token, form)
            if times and time_ns <= times[-1]:
                message = "must be later than that of the state before"
                raise self._source.bad(token.line, "EPOCH", message, _epoch(token))
            times.append(time_ns)
            numbers.append(quaternion)
            self._records += 1
            if self._records > MOST_RECORDS:
                message = f"the file has more than the {MOST_RECORDS:,} states that are read"
                raise self._source.bad(token.line, "states", message)
        raise self._source.bad(form.line, "DATA_STOP", "is missing: the file was cut short")

    def _metadata(self, tokens: Iterator[Token], line: int) -> _Metadata:
        found = _Metadata(line)
        for token in tokens:
            if token.name == "META_STOP":
                found.line = token.line
                return found
            if token.kind != "key" or token.name not in _METADATA:
                raise self._bad(token, "is no keyword of an AEM's metadata")
            if token.name in found.values:
                raise self._bad(token, f"is there already, in line {found.lines[token.name]}")
            if self._version > 1 and token.name in _V1_ONLY:
                raise self._bad(
                    token,
                    "is of version 1: in version 2 quaternions have the scalar last and transform "
                    "from REF_FRAME_A to REF_FRAME_B",
                )
            found.values[token.name] = token.value
            found.lines[token.name] = token.line
        raise self._source.bad(line, "META_STOP", "is missing: the file was cut short")

    def _form(self, told: _Metadata) -> _Form:
        self._require(told, _REQUIRED)
        numbers = _NUMBERS[self._version]
        type = self._one_of(told, "ATTITUDE_TYPE", tuple(numbers))
        if self._version == 1:
            self._require(told, tuple(_V1_ONLY))
        time_system = self._one_of(told, "TIME_SYSTEM", TIME_SYSTEMS)
        spans = {name: self._moment(told, name, time_system) for name in _TIMES}
        first, last = spans["START_TIME"], spans["STOP_TIME"]
        assert first is not None
        assert last is not None
        if first > last:
            raise self._fault(told, "STOP_TIME", "must not be before START_TIME")
        about = (told.values["OBJECT_NAME"], told.values["OBJECT_ID"])
        if self._object not in (None, about):
            raise self._fault(told, "OBJECT_ID", "must be the same in every segment")
        self._object = about
        return _Form(
            line=told.line,
            time_system=time_system,
            numbers=numbers[type],
            scalar_first=self._v1_keyword(told, "QUATERNION_TYPE") == "FIRST",
            is_inverse=self._from_body(told) != (self._v1_keyword(told, "ATTITUDE_DIR") == "B2A"),
            useable_ns=(spans["USEABLE_START_TIME"], spans["USEABLE_STOP_TIME"]),
        )

    def _require(self, told: _Metadata, names: tuple[str, ...]) -> None:
        for name in names:
            if not told.values.get(name):
                raise self._source.bad(told.line, name, "is missing in the metadata")

    def _one_of(self, told: _Metadata, name: str, known: tuple[str, ...]) -> str:
        value = told.values[name].upper()
        if value not in known:
            raise self._fault(told, name, f"must be one of {', '.join(known)}")
        return value

    def _v1_keyword(self, told: _Metadata, name: str) -> str:
        return self._one_of(told, name, _V1_ONLY[name]) if self._version == 1 else ""

    def _moment(self, told: _Metadata, name: str, time_system: str) -> int | None:
        if name not in told.values:
            return None
        try:
            return epoch_ns(told.values[name], time_system)
        except ValueError as error:
            raise self._fault(told, name, str(error)) from None

    def _from_body(self, told: _Metadata) -> bool:
        """Whether REF_FRAME_A is the body; the other frame must be inertial."""
        frames = {name: told.values[name].upper() for name in ("REF_FRAME_A", "REF_FRAME_B")}
        is_body = {name: bool(_BODY.fullmatch(frame)) for name, frame in frames.items()}
        for name, frame in frames.items():
            if not is_body[name] and frame not in INERTIAL:
                message = f"must be one of {', '.join(INERTIAL)}, or the body as SC_BODY_1"
                raise self._fault(told, name, message)
        if is_body["REF_FRAME_A"] == is_body["REF_FRAME_B"]:
            message = "one of REF_FRAME_A and REF_FRAME_B must be inertial, the other the body"
            raise self._fault(told, "REF_FRAME_B", message)
        return is_body["REF_FRAME_A"]

    def _state(self, token: Token, form: _Form) -> tuple[int, tuple[float, ...]]:
        words = token.words if token.names is None else self._named(token)
        if token.names is None and len(words) != 1 + form.numbers:
            message = f"must have an epoch and {form.numbers} numbers"
            raise self._source.bad(token.line, "state", message, " ".join(words))
        try:
            time_ns = epoch_ns(words[0], form.time_system)
        except ValueError as error:
            raise self._source.bad(token.line, "EPOCH", str(error), words[0]) from None
        numbers = [self._number(token, word) for word in words[1:]]
        quaternion = numbers[:4]
        if form.scalar_first and token.names is None:
            quaternion = [*numbers[1:4], numbers[0]]
        norm = math.hypot(*quaternion)
        if not abs(norm - 1.0) <= NORM_TOLERANCE:
            message = f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}"
            raise self._source.bad(token.line, "quaternion", message, quaternion)
        return time_ns, tuple(quaternion)

    def _named(self, token: Token) -> tuple[str, ...]:
        """The epoch and the quaternion of an XML state, scalar last: elements have names."""
        assert token.names is not None
        named = dict(zip(token.names, token.words, strict=True))
        for name in ("EPOCH", "Q1", "Q2", "Q3", "QC"):
            if token.names.count(name) != 1:
                raise self._source.bad(token.line, name, "must be there once in a state")
        return tuple(named[name] for name in ("EPOCH", "Q1", "Q2", "Q3", "QC"))

    def _number(self, token: Token, word: str) -> float:
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or "_" in word:
            raise self._source.bad(token.line, "state", "must be a number", word)
        return number

    def _made(self, form: _Form, times: list[int], numbers: list[tuple[float, ...]]) -> Segment:
        time_ns = np.array(times, dtype=np.int64)
        quaternion = np.array(numbers)
        quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
        if form.is_inverse:
            quaternion[:, :3] *= -1.0
        first, last = form.useable_ns
        return Segment(
            f"line {form.line}",
            time_ns,
            quaternion,
            times[0] if first is None else max(first, times[0]),
            times[-1] if last is None else min(last, times[-1]),
        )

    def _fault(self, told: _Metadata, name: str, message: str) -> Exception:
        return self._source.bad(told.lines[name], name, message, told.values[name])

    def _bad(self, token: Token, message: str) -> Exception:
        return self._source.bad(token.line, token.name, message, token.value or None)


def _epoch(token: Token) -> str:
    if token.names is None:
        return token.words[0]
    return dict(zip(token.names, token.words, strict=True)).get("EPOCH", "")
