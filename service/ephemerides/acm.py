"""Reader of ACM version 2 (CCSDS 504.0-B-2), KVN and XML: attitude states of a spacecraft body.

Blocks of states are read as Orekit reads them.  Orbits, physical properties, covariances,
manoeuvres and descriptions of attitude determination are skipped.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations_with_replacement
from operator import mul
from typing import IO

import numpy as np

from service.ephemerides import tokens as ccsds
from service.ephemerides.attitude_types import AttitudeType, Frames, body_attitudes
from service.ephemerides.known import (
    KnownAttitudes,
    Segment,
    by_priority,
    in_order,
    known_attitudes,
    told_rates,
)
from service.observations.schema import NORM_TOLERANCE
from service.times import FIRST_YEAR, LAST_YEAR

_TYPES: dict[str, AttitudeType] = {
    "QUATERNION": AttitudeType("quaternion"),
    "EULER_ANGLES": AttitudeType("euler"),
    "DCM": AttitudeType("dcm"),
}
_RATES: dict[str, AttitudeType] = {
    "ANGVEL": AttitudeType("quaternion", "angvel"),
    "Q_DOT": AttitudeType("quaternion", "q_dot"),
    "EULER_RATE": AttitudeType("quaternion", "euler"),
}
_FIRST_NS = ccsds.epoch_ns(f"{FIRST_YEAR}-01-01T00:00:00", "TAI")
_LAST_NS = ccsds.epoch_ns(f"{LAST_YEAR}-12-31T23:59:59", "TAI")
_NO_RATES = {"": 0, "NONE": 0, "GYRO_BIAS": 3}
"""Number of values in a state for each RATE_TYPE that is not a rate."""
TRUE_BASES = ("", "DETERMINED_GND", "DETERMINED_OBC", "SIMULATED")
"""Values of ATT_BASIS for attitudes that are not predicted; empty if the file gives none."""
_BLOCKS = ("ORB", "PHYS", "COV", "MAN", "AD", "SENSOR", "USER")
_HEADER = ("CLASSIFICATION", "CREATION_DATE", "ORIGINATOR", "MESSAGE_ID")
_METADATA = (
    *("OBJECT_NAME", "INTERNATIONAL_DESIGNATOR", "CATALOG_NAME", "OBJECT_DESIGNATOR"),
    *(f"ORIGINATOR_{each}" for each in ("POC", "POSITION", "PHONE", "EMAIL", "ADDRESS")),
    *("ODM_MSG_LINK", "CENTER_NAME", "TIME_SYSTEM", "EPOCH_TZERO", "ACM_DATA_ELEMENTS"),
    *("START_TIME", "STOP_TIME", "TAIMUTC_AT_TZERO", "NEXT_LEAP_EPOCH", "NEXT_LEAP_TAIMUTC"),
)
_BLOCK = (
    *("ATT_ID", "ATT_PREV_ID", "ATT_BASIS", "ATT_BASIS_ID", "REF_FRAME_A", "REF_FRAME_B"),
    *("NUMBER_STATES", "ATT_TYPE", "RATE_TYPE", "EULER_ROT_SEQ"),
)
_FORM = ccsds.MessageForm(
    kind="ACM",
    marks=tuple(
        f"{block}_{end}" for block in ("META", "ATT", *_BLOCKS) for end in ("START", "STOP")
    ),
    before_states=tuple(f"{block}_START" for block in ("ATT", *_BLOCKS)),
    parts={
        "metadata": ("META_START", "META_STOP"),
        **{block.lower(): (f"{block}_START", f"{block}_STOP") for block in ("ATT", *_BLOCKS)},
    },
    state="attLine",
)


def read_acm(name: str, file: IO[bytes]) -> KnownAttitudes:
    """Read the attitudes of an ACM message; raises `BadFile` naming file, line and field."""
    return _Reader(ccsds.Source(name)).read(file)


class _Reader(ccsds.MessageReader):
    def read(self, file: IO[bytes]) -> KnownAttitudes:
        source = self._source
        tokens = ccsds.tokens_of(source, file, _FORM)
        ccsds.read_version(source, next(tokens, None), _FORM, ("2.0",))
        metadata: ccsds.Metadata | None = None
        segments: list[Segment] = []
        for token in tokens:
            if metadata is None:
                if token.kind == "key" and token.name in _HEADER:
                    continue
                if token.name != "META_START":
                    raise source.bad_token(token, "is out of place: META_START is expected")
                metadata = ccsds.read_metadata(source, tokens, token.line, _METADATA, _FORM)
                metadata.require(("OBJECT_NAME", "TIME_SYSTEM", "EPOCH_TZERO"))
                self._object = (metadata.values["OBJECT_NAME"], "")
            elif token.name == "ATT_START":
                segments.append(self._segment(metadata, tokens, token.line))
            elif token.kind == "mark" and token.name.endswith("_START"):
                self._pass_block(tokens, token)
            else:
                raise source.bad_token(token, "is out of place: the start of a block is expected")
        if metadata is None:
            raise source.bad(1, "META_START", "is missing: the message has no metadata")
        if not segments:
            raise source.bad(metadata.line, "ATT_START", "is missing: the message has no attitude")
        predicted = [each for each in segments if each.basis == "PREDICTED"]
        others = [each for each in segments if each.basis != "PREDICTED"]
        if predicted and others:
            # At a time in both parts, the attitude that was not predicted has precedence.
            parts = (in_order(source.name, predicted), in_order(source.name, others))
            segments = by_priority([*parts[0], *parts[1]])
        return known_attitudes(source.name, self._object_name, segments)

    def _pass_block(self, tokens: Iterator[ccsds.Token], start: ccsds.Token) -> None:
        stop = start.name.replace("_START", "_STOP")
        for token in tokens:
            if token.name == stop:
                return
        raise self._source.bad(start.line, stop, "is missing: the file was cut short")

    def _segment(
        self, metadata: ccsds.Metadata, tokens: Iterator[ccsds.Token], line: int
    ) -> Segment:
        """Read the states of an attitude block, up to ATT_STOP."""
        block = ccsds.Metadata(self._source, line)
        times: list[int] = []
        states: list[list[float]] = []
        size = 0
        for token in tokens:
            if token.name == "ATT_STOP":
                if not times:
                    raise self._source.bad(token.line, "ATT_STOP", "ends a block of no state")
                return self._made(block, times, states)
            if token.kind == "key" and token.name in _BLOCK and not times:
                if token.name in block.values:
                    message = f"is there already, in line {block.lines[token.name]}"
                    raise self._source.bad_token(token, message)
                block.values[token.name], block.lines[token.name] = token.value, token.line
                block.line = token.line
                continue
            if token.kind != "state":
                raise self._source.bad_token(token, "is out of place in a block of attitudes")
            if not times:
                size = self._size(block)
            if len(token.words) != 1 + size:
                message = f"must have a time and {size} numbers"
                raise self._source.bad(token.line, "state", message, " ".join(token.words))
            time_ns = self._time_ns(metadata, token)
            self._count_state(token, token.words[0], time_ns, times)
            times.append(time_ns)
            states.append([self._source.number(token, word) for word in token.words[1:]])
            self._check_attitude(_type(block), token, states[-1])
        raise self._source.bad(line, "ATT_STOP", "is missing: the file was cut short")

    def _check_attitude(self, type: AttitudeType, token: ccsds.Token, state: list[float]) -> None:
        if type.attitude == "quaternion":
            norm = math.hypot(*state[:4])
            if not abs(norm - 1.0) <= NORM_TOLERANCE:
                message = f"must have norm 1 within {NORM_TOLERANCE}; its norm is {norm:.6g}"
                raise self._source.bad(token.line, "quaternion", message, state[:4])
        if type.attitude == "dcm" and not _is_rotation(state[:9]):
            message = f"must be a rotation: M M^T = 1 within {NORM_TOLERANCE}, and det M above 0"
            raise self._source.bad(token.line, "matrix", message, state[:9])

    def _size(self, block: ccsds.Metadata) -> int:
        """Number of values in a state, without its time."""
        block.require(("REF_FRAME_A", "REF_FRAME_B", "ATT_TYPE"))
        block.one_of("ATT_TYPE", tuple(_TYPES))
        rate = block.values.get("RATE_TYPE", "").upper()
        if rate not in (*_RATES, *_NO_RATES):
            known = ", ".join([*_RATES, *filter(None, _NO_RATES)])
            raise block.fault("RATE_TYPE", f"must be one of {known}")
        size = _type(block).size + _NO_RATES.get(rate, 0)
        told = block.values.get("NUMBER_STATES")
        if told is not None and told != str(size):
            message = f"must be {size}, the numbers of a state of its types after the time"
            raise block.fault("NUMBER_STATES", message)
        return size

    def _time_ns(self, metadata: ccsds.Metadata, token: ccsds.Token) -> int:
        """Time of a state, given as UTC or in seconds after EPOCH_TZERO."""
        time_system = metadata.time_system()
        word = token.words[0]
        if "T" in word.upper():
            return self._source.epoch_ns(token, word, time_system)
        zero_ns = metadata.moment("EPOCH_TZERO", time_system)
        assert zero_ns is not None
        after_ns = self._source.number(token, word) * 1e9
        if not _FIRST_NS <= zero_ns + after_ns <= _LAST_NS:
            message = f"must have a time of the years from {FIRST_YEAR} to {LAST_YEAR}"
            raise self._source.bad(token.line, "state", message, word)
        return zero_ns + round(after_ns)

    def _made(self, block: ccsds.Metadata, times: list[int], states: list[list[float]]) -> Segment:
        type = _type(block)
        sequence = ""
        if "euler" in (type.attitude, type.rates):
            sequence = ccsds.euler_sequence(block)
        from_body = ccsds.from_body(block)
        # Angular velocities are of B relative to A, about the axes of B.
        frames = Frames(sequence, from_body, from_body, rate_in_body=not from_body)
        quaternion, rate = body_attitudes(type, np.array(states)[:, : type.size], frames)
        time_ns = np.array(times, dtype=np.int64)
        rate = told_rates(quaternion, rate)
        span = (f"line {block.line}", time_ns, times[0], times[-1])
        return Segment(*span, quaternion, rate, basis=block.values.get("ATT_BASIS", "").upper())


def _is_rotation(numbers: Sequence[float]) -> bool:
    """True if nine numbers, row by row, are a rotation matrix."""
    x, y, z = numbers[:3], numbers[3:6], numbers[6:]
    is_orthonormal = all(
        abs(sum(map(mul, one, other)) - (one is other)) <= NORM_TOLERANCE
        for one, other in combinations_with_replacement((x, y, z), 2)
    )
    return is_orthonormal and float(np.linalg.det([x, y, z])) > 0.0


def _type(block: ccsds.Metadata) -> AttitudeType:
    rate = _RATES.get(block.values.get("RATE_TYPE", "").upper())
    type = _TYPES[block.values["ATT_TYPE"].upper()]
    return type if rate is None else replace(type, rates=rate.rates)
