"""Reader of OEM versions 1 to 3 (CCSDS 502.0-B), KVN and XML: states of a spacecraft.

States are geocentric, in km and km/s.  Accelerations and covariances are skipped.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO

import numpy as np

from service.ephemerides import tokens as ccsds
from service.ephemerides.known import (
    Interpolation,
    KnownStates,
    StateSegment,
    known_states,
)

_VERSIONS = ("1.0", "2.0", "3.0")
_HEADER = ("CREATION_DATE", "ORIGINATOR", "MESSAGE_ID", "CLASSIFICATION")
_REQUIRED = (
    "OBJECT_NAME",
    "OBJECT_ID",
    "CENTER_NAME",
    "REF_FRAME",
    "TIME_SYSTEM",
    "START_TIME",
    "STOP_TIME",
)
_METADATA = (
    *_REQUIRED,
    "REF_FRAME_EPOCH",
    "USEABLE_START_TIME",
    "USEABLE_STOP_TIME",
    "INTERPOLATION",
    "INTERPOLATION_DEGREE",
)
_METHODS: dict[str, Interpolation] = {
    "HERMITE": "HERMITE",
    "LAGRANGE": "LAGRANGE",
    "LINEAR": "LAGRANGE",
}
MOST_DEGREE = 19
"""Greatest degree of interpolation; higher ones follow the rounding errors of states."""
DEFAULT_DEGREE = 7
"""Degree of Hermite interpolation if the file names none."""
EARTH_GM_KM3_PER_S2 = 398600.4418
LONGEST_ARC_RAD = 0.5
"""Greatest arc in radians over which velocities are compared with the motion of positions."""
VELOCITY_SHARE = 0.05
"""Largest difference of velocities from the motion of positions, as a share of its speed."""
ROUNDED_KM = 0.01
"""Error of the difference of two positions in km."""
LONGEST_STEP_OF_PERIOD = 1 / 12
"""Longest step between states, in orbital periods, for a file that names no interpolation."""
SHORT_NS = 10**9
"""Nanoseconds by which states may miss START_TIME and STOP_TIME; more is a cut file."""
MAX_KM, MAX_KM_PER_S = 1e9, 100.0
_NAMES = ("EPOCH", "X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")


@dataclass
class _Form:
    """Layout of an orbit segment by its metadata, with the states read so far."""

    line: int
    time_system: str
    span_ns: tuple[int, int]
    useable_ns: tuple[int | None, int | None]
    method: Interpolation
    degree: int | None
    has_ended: bool = False
    """True once the segment's covariances have begun, which follow its states."""
    times: list[int] = field(default_factory=list)
    states: list[list[float]] = field(default_factory=list)


def read_oem(name: str, file: IO[bytes]) -> KnownStates:
    """Read the states of an OEM message; raises `BadFile` naming file, line and field."""
    return _Reader(ccsds.Source(name)).read(file)


class _Reader(ccsds.MessageReader):
    def read(self, file: IO[bytes]) -> KnownStates:
        tokens = ccsds.tokens_of(self._source, file, ccsds.OEM)
        ccsds.read_version(self._source, next(tokens, None), ccsds.OEM, _VERSIONS)
        segments: list[StateSegment] = []
        form: _Form | None = None
        last = 1
        for token in tokens:
            last = token.line
            if token.name == "META_START":
                if form is not None:
                    segments.append(self._made(form, last))
                form = self._form(
                    ccsds.read_metadata(self._source, tokens, token.line, _METADATA, ccsds.OEM)
                )
            elif form is None:
                if token.kind != "key" or token.name not in _HEADER:
                    raise self._source.bad_token(token, "is out of place: META_START is expected")
            elif token.name == "COVARIANCE_START":
                self._pass_covariances(tokens, token.line)
                form.has_ended = True
            elif token.kind == "state" and not form.has_ended:
                self._add(form, token)
            else:
                raise self._source.bad_token(token, "is out of place among the states")
        if form is None:
            raise self._source.bad(last, "META_START", "is missing: the message has no segment")
        segments.append(self._made(form, last))
        return known_states(self._source.name, self._object_name, segments)

    def _pass_covariances(self, tokens: Iterator[ccsds.Token], line: int) -> None:
        for token in tokens:
            if token.name == "COVARIANCE_STOP":
                return
        raise self._source.bad(line, "COVARIANCE_STOP", "is missing: the file was cut short")

    def _form(self, metadata: ccsds.Metadata) -> _Form:
        metadata.require(_REQUIRED)
        metadata.one_of("CENTER_NAME", ("EARTH",))
        metadata.one_of("REF_FRAME", ccsds.INERTIAL)
        time_system = metadata.time_system()
        self._check_object(metadata)
        method, degree = self._interpolation(metadata)
        return _Form(
            line=metadata.line,
            time_system=time_system,
            span_ns=metadata.span(time_system),
            useable_ns=metadata.useable(time_system),
            method=method,
            degree=degree,
        )

    def _interpolation(self, metadata: ccsds.Metadata) -> tuple[Interpolation, int | None]:
        """Interpolation method of a segment, and its degree if named."""
        if "INTERPOLATION" not in metadata.values:
            return "HERMITE", None
        name = metadata.one_of("INTERPOLATION", tuple(_METHODS))
        if name == "LINEAR":
            return "LAGRANGE", 1
        metadata.require(("INTERPOLATION_DEGREE",))
        text = metadata.values["INTERPOLATION_DEGREE"]
        if not (text.isascii() and text.isdigit() and 1 <= int(text) <= MOST_DEGREE):
            message = f"must be a whole number from 1 to {MOST_DEGREE}"
            raise metadata.fault("INTERPOLATION_DEGREE", message)
        return _METHODS[name], int(text)

    def _add(self, form: _Form, token: ccsds.Token) -> None:
        words = token.words if token.names is None else self._source.named(token, _NAMES)
        if len(words) not in (7, 10):
            message = "must have an epoch, a position and a velocity"
            raise self._source.bad(token.line, "state", message, " ".join(words))
        time_ns = self._source.epoch_ns(token, words[0], form.time_system)
        self._count_state(token, words[0], time_ns, form.times)
        state = [self._source.number(token, word) for word in words[1:]][:6]
        for name, most, unit in (("position", MAX_KM, "km"), ("velocity", MAX_KM_PER_S, "km/s")):
            part = state[:3] if name == "position" else state[3:]
            if max(map(abs, part)) > most:
                raise self._source.bad(token.line, name, f"must be within {most:g} {unit}", part)
        form.times.append(time_ns)
        form.states.append(state)

    def _made(self, form: _Form, line: int) -> StateSegment:
        """Orbit segment made from the states read; `line` is that of its last token."""
        if not form.times:
            raise self._source.bad(form.line, "META_STOP", "begins a segment of no state")
        if form.times[0] > form.span_ns[0] + SHORT_NS:
            raise self._source.bad(form.line, "states", "the first state is later than START_TIME")
        if form.times[-1] < form.span_ns[1] - SHORT_NS:
            message = "the last state is earlier than STOP_TIME: the file was cut short"
            raise self._source.bad(line, "states", message)
        count = len(form.times)
        points = self._points(form, count)
        if form.degree is None:
            self._check_steps(form)
        self._check_velocities(form)
        return StateSegment(
            f"line {form.line}",
            np.array(form.times, dtype=np.int64),
            *ccsds.useable_span(form.times, form.useable_ns),
            np.array(form.states),
            form.method,
            points,
        )

    def _check_steps(self, form: _Form) -> None:
        """Raise `BadFile` for states too far apart, in periods of a circular orbit there."""
        step_s = np.diff(np.array(form.times)) * 1e-9
        radius_km = np.linalg.norm(np.array(form.states)[:, :3], axis=1)
        lower_km = np.minimum(radius_km[:-1], radius_km[1:])
        longest_s = LONGEST_STEP_OF_PERIOD * math.tau * np.sqrt(lower_km**3 / EARTH_GM_KM3_PER_S2)
        for k in np.flatnonzero(step_s > longest_s)[:1]:
            raise self._source.bad(
                form.line,
                "INTERPOLATION",
                f"is missing, and {step_s[k]:.0f} s lie between two of its states, where at most "
                f"{longest_s[k]:.0f} s give positions to about a kilometre",
            )

    def _check_velocities(self, form: _Form) -> None:
        """Refuse velocities that are not the motion of the positions, such as zeros for none.

        Velocities relative to the rotating Earth are refused too where they differ enough.
        """
        states = np.array(form.states)
        step_s = np.diff(np.array(form.times)) * 1e-9
        moved = np.diff(states[:, :3], axis=0) / step_s[:, None]
        mean = 0.5 * (states[1:, 3:] + states[:-1, 3:])
        speed = np.linalg.norm(moved, axis=1)
        radius_km = np.linalg.norm(states[:, :3], axis=1)
        # Over a longer arc the mean of both velocities is not that of the arc.
        is_short = speed * step_s < LONGEST_ARC_RAD * np.minimum(radius_km[1:], radius_km[:-1])
        missed = np.linalg.norm(moved - mean, axis=1)
        # Positions may be rounded to metres.
        least = VELOCITY_SHARE * speed + ROUNDED_KM / step_s
        for k in np.flatnonzero(is_short & (missed > least))[:1]:
            raise self._source.bad(
                form.line,
                "velocity",
                f"of states {k + 1} and {k + 2} of the segment is not that of their positions, "
                f"{speed[k]:.4g} km/s",
                states[k, 3:].tolist(),
            )

    def _points(self, form: _Form, count: int) -> int:
        """Number of states that the interpolating polynomial passes through."""
        degree = DEFAULT_DEGREE if form.degree is None else form.degree
        # A state gives Hermite's polynomial two conditions, its position and its velocity; through
        # one alone would be a line that ends at the next.
        points = degree + 1 if form.method == "LAGRANGE" else max(degree // 2 + 1, 2)
        if form.degree is None:
            return min(points, count)
        if points > count:
            message = f"degree {degree} needs {points} states; the segment has {count}"
            raise self._source.bad(form.line, "INTERPOLATION_DEGREE", message)
        return points
