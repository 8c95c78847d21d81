"""Conversion of a calibration to mission settings: alignment, focal plane and magnitudes."""

import math
import re
from collections.abc import Mapping

import numpy as np
from numpy.polynomial.legendre import leg2poly

from service.errors import BadConfiguration
from service.features.calibration.estimate import Calibration
from service.features.calibration.linearise import SKEW, STRETCH, Unknown
from service.missions.mission import Magnitudes, Mission, Tracker, parse_mission
from service.vectors import ARCSEC_PER_RADIAN, Matrix, rotate_about

AXES = ("x_axis_body", "y_axis_body", "z_axis_body")
Lines = dict[str, str]
Terms = tuple[tuple[int, int, float], ...]

_HEADER = re.compile(r"^\s*\[")
_TRACKERS = re.compile(r"^\s*\[\[\s*trackers\s*\]\]")
_TABLES = {
    name: re.compile(rf"^\s*\[\s*trackers\.{name}\s*\]") for name in ("calibration", "magnitudes")
}
_KEY = re.compile(r"^\s*([A-Za-z_]+)\s*=")


def calibrated_mission_text(
    text: str,
    file: str,
    found: Calibration,
    in_force: Mission | None = None,
    magnitudes: Mapping[str, Magnitudes] | None = None,
) -> str:
    """Text of a mission file with a calibration's alignment, scale and distortion written into it.

    `in_force` are the settings that the calibration started from, if they are not the file's:
    differences are written as well.  `magnitudes` are the calibrated ones of trackers by name;
    others stay as in `in_force`.  All other lines stay unchanged.  Raises `BadConfiguration` for a
    file whose trackers are not laid out as `[[trackers]]` with each axis in one line.
    """
    mission = parse_mission(text, file)
    lines = text.splitlines()
    based = {each.name: each for each in (in_force or mission).trackers}
    known = {name: each.magnitudes for name, each in based.items()} | dict(magnitudes or {})
    expected = {
        each.name: tracker_lines(based.get(each.name, each), found, each)
        | {"magnitudes": magnitude_lines(known.get(each.name, each.magnitudes), each)}
        for each in mission.trackers
    }
    for index in reversed(range(len(mission.trackers))):
        changes = expected[mission.trackers[index].name]
        if any(changes.values()):
            _edit(lines, index, changes)
    edited = "\n".join(lines) + "\n"
    if not _holds(parse_mission(edited, file), mission, expected):
        message = "cannot be edited: write each axis of [[trackers]] in one line of its own"
        raise BadConfiguration(f"{file}: {message}")
    return edited


def tracker_lines(
    tracker: Tracker, found: Calibration, own: Tracker | None = None
) -> dict[str, Lines]:
    """Changed keys of a tracker and of its table `calibration`, each with its value as TOML.

    `own` is the tracker as in the mission file, if the calibration started from other settings.
    """
    lines = _corrected(tracker, found)
    if own is None:
        return lines
    if not lines["tracker"] and not np.array_equal(
        own.body_from_tracker, tracker.body_from_tracker
    ):
        axes = tracker.body_from_tracker.T
        lines["tracker"] = {name: _vector(axis) for name, axis in zip(AXES, axes, strict=True)}
    if not lines["calibration"] and own.calibration != tracker.calibration:
        lines["calibration"] = _focal_plane(tracker, {})
    return lines


def magnitude_lines(magnitudes: Magnitudes, own: Tracker) -> Lines:
    """Keys of the table `magnitudes` for a tracker in a mission file; empty if unchanged."""
    if magnitudes == own.magnitudes:
        return {}
    return {name: repr(value) for name, value in magnitudes.model_dump().items()}


def _corrected(tracker: Tracker, found: Calibration) -> dict[str, Lines]:
    values = {
        unknown: float(value)
        for unknown, value in zip(found.unknowns, found.value, strict=True)
        if found.stars.trackers[unknown.tracker].name == tracker.name
    }
    own: Lines = {}
    turned = {each.term[0]: value for each, value in values.items() if each.kind == "alignment"}
    if turned:
        vector = np.array([turned.get(axis, 0.0) for axis in "xyz"]) / ARCSEC_PER_RADIAN
        axes = rotate_about(vector, tracker.body_from_tracker.T)
        own = {name: _vector(axis) for name, axis in zip(AXES, axes, strict=True)}
    bent = {each: value for each, value in values.items() if each.kind in ("scale", "distortion")}
    return {"tracker": own, "calibration": _focal_plane(tracker, bent) if bent else {}}


def _vector(axis: Matrix) -> str:
    return "[" + ", ".join(f"{part:.12f}" for part in axis) + "]"


def _focal_plane(tracker: Tracker, bent: Mapping[Unknown, float]) -> Lines:
    """Table `calibration` of a mission file: present polynomials plus estimated corrections."""
    present = tracker.calibration
    scale = present.scale + sum(value for each, value in bent.items() if each.kind == "scale")
    added = _polynomials_deg(bent, tracker.field_of_view_radius_deg)
    lines: Lines = {"scale": repr(scale)}
    for name, terms, more in (
        ("h_terms", present.h_terms, added[0]),
        ("v_terms", present.v_terms, added[1]),
    ):
        total = dict(more)
        for i, j, value in terms:
            total[i, j] = total.get((i, j), 0.0) + present.scale * value
        written = [
            f"[{i}, {j}, {value / scale:.9e}]" for (i, j), value in sorted(total.items()) if value
        ]
        if written:
            lines[name] = "[" + ", ".join(written) + "]"
    return lines


def _polynomials_deg(
    bent: Mapping[Unknown, float], radius_deg: float
) -> tuple[dict[tuple[int, int], float], ...]:
    """Terms to add to h and v, in degrees: coefficients by their powers of measured h and v."""
    size = max((each.degree for each in bent), default=0) + 1
    series = np.zeros((2, size, size))
    for each, value in bent.items():
        kind, i, j = each.term
        value_deg = value / 3600.0
        if each.kind == "scale":
            continue
        if kind == STRETCH:
            series[0, 1, 0], series[1, 0, 1] = value_deg, -value_deg
        elif kind == SKEW:
            series[0, 0, 1], series[1, 1, 0] = value_deg, value_deg
        else:
            series["hv".index(kind), i, j] = value_deg
    powers = np.zeros((size, size))
    for degree in range(size):
        unit = np.zeros(degree + 1)
        unit[degree] = 1.0
        powers[degree, : degree + 1] = leg2poly(unit)
    per_deg = float(radius_deg) ** -np.arange(size)
    found = np.einsum("aij,ik,jl,k,l->akl", series, powers, powers, per_deg, per_deg)
    return tuple(
        {(i, j): float(one[i, j]) for i in range(size) for j in range(size) if one[i, j]}
        for one in found
    )


def _edit(lines: list[str], index: int, changes: Mapping[str, Lines]) -> None:
    """Replace the changed keys of tracker number `index` in the lines of a mission file."""
    places = [at for at, line in enumerate(lines) if _TRACKERS.match(line)]
    if index >= len(places):
        return
    begin = places[index] + 1
    end = next((at for at in range(begin, len(lines)) if _HEADER.match(lines[at])), len(lines))
    for at in range(begin, end):
        key = _KEY.match(lines[at])
        if key and key[1] in changes["tracker"]:
            lines[at] = f"{key[1]} = {changes['tracker'][key[1]]}"
    for table in _TABLES:
        if changes[table]:
            _write_table(lines, begin, table, changes[table])


def _write_table(lines: list[str], begin: int, table: str, changes: Lines) -> None:
    """Write a table of the tracker that begins at a line: over the old table, or after its keys."""
    end = next((at for at in range(begin, len(lines)) if _HEADER.match(lines[at])), len(lines))
    following = next(
        (at for at in range(begin, len(lines)) if _TRACKERS.match(lines[at])), len(lines)
    )
    old = next((at for at in range(end, following) if _TABLES[table].match(lines[at])), None)
    if old is not None:
        last = next(
            (at for at in range(old + 1, len(lines)) if _HEADER.match(lines[at])), len(lines)
        )
        del lines[old:last]
    else:
        old = end
        while old > begin and not lines[old - 1].strip():
            old -= 1
        lines.insert(old, "")
        old += 1
    written = [f"{key} = {value}" for key, value in changes.items()]
    lines[old:old] = [f"[trackers.{table}]", *written, ""]


def _holds(edited: Mission, before: Mission, expected: Mapping[str, Mapping[str, Lines]]) -> bool:
    """True if the edited mission has all expected changes and no others."""
    for old, new in zip(before.trackers, edited.trackers, strict=True):
        wanted = expected[old.name]
        for key, value in wanted["tracker"].items():
            axis = [float(part) for part in value.strip("[]").split(",")]
            if not np.allclose(getattr(new, key), axis, atol=1e-12):
                return False
        if wanted["calibration"]:
            scale = float(wanted["calibration"]["scale"])
            if not math.isclose(new.calibration.scale, scale, rel_tol=1e-12):
                return False
        magnitudes = {key: float(value) for key, value in wanted["magnitudes"].items()}
        if magnitudes and new.magnitudes.model_dump() != magnitudes:
            return False
    same = [
        new.model_copy(update={name: getattr(old, name) for name in (*AXES, *_TABLES)})
        for old, new in zip(before.trackers, edited.trackers, strict=True)
    ]
    return edited.model_copy(update={"trackers": tuple(same)}) == before
