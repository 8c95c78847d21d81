"""Alignment, focal plane and magnitudes of trackers: taken out, calibrated, and put in."""

import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from service.calibration.estimate import Calibration
from service.calibration.mission_file import Lines, magnitude_lines, tracker_lines
from service.missions.corrections import AS_MEASURED, Magnitudes
from service.missions.corrections import Calibration as FocalPlaneSettings
from service.missions.mission import Mission, Tracker
from service.storage.calibrations import FocalPlane, TrackerGeometry, TrackerMagnitudes


def geometry_of(tracker: Tracker) -> TrackerGeometry:
    """Alignment, focal plane and magnitudes of a tracker."""
    plane = tracker.calibration
    return TrackerGeometry(
        name=tracker.name,
        x_axis_body=list(tracker.x_axis_body),
        y_axis_body=list(tracker.y_axis_body),
        z_axis_body=list(tracker.z_axis_body),
        calibration=FocalPlane(
            scale=plane.scale,
            h_terms=[list(each) for each in plane.h_terms],
            v_terms=[list(each) for each in plane.v_terms],
        ),
        magnitudes=TrackerMagnitudes(**tracker.magnitudes.model_dump()),
    )


def geometry_digest(mission: Mission) -> str:
    """`sha256:` of alignment, focal plane and magnitudes of all trackers, and of nothing else."""
    told = [msgspec.to_builtins(geometry_of(each)) for each in mission.trackers]
    for each, tracker in zip(told, mission.trackers, strict=True):
        # Adoptions of versions without magnitudes hold the digest of the rest.
        if tracker.magnitudes == AS_MEASURED:
            del each["magnitudes"]
    return "sha256:" + hashlib.sha256(msgspec.json.encode(told)).hexdigest()


def with_geometry(mission: Mission, trackers: Sequence[TrackerGeometry]) -> Mission:
    """The mission with the calibrations of these trackers; those not named stay as they are."""
    named = {each.name: each for each in trackers}
    changed = tuple(
        _with(each, named[each.name]) if each.name in named else each for each in mission.trackers
    )
    return mission.model_copy(update={"trackers": changed})


def _with(tracker: Tracker, geometry: TrackerGeometry) -> Tracker:
    told = msgspec.to_builtins(geometry)
    if geometry.magnitudes is None:
        del told["magnitudes"]
    settings = {
        **tracker.model_dump(exclude={"camera"}),
        **told,
        "camera": tracker.camera,
    }
    return Tracker.model_validate(settings)


def calibrated_geometry(
    mission: Mission, found: Calibration, magnitudes: Mapping[str, Magnitudes]
) -> list[TrackerGeometry]:
    """Every tracker of a mission with what a calibration changes of it."""
    return [
        _calibrated(
            each.model_copy(update={"magnitudes": magnitudes[each.name]}),
            tracker_lines(each, found),
        )
        for each in mission.trackers
    ]


def _calibrated(tracker: Tracker, changes: dict[str, Lines]) -> TrackerGeometry:
    own: dict[str, Any] = {
        name: tuple(value) for name, value in _values(changes["tracker"]).items()
    }
    if changes["calibration"]:
        told = _values(changes["calibration"])
        own["calibration"] = FocalPlaneSettings.model_validate(told)
    return geometry_of(tracker.model_copy(update=own))


def _values(lines: Lines) -> dict[str, Any]:
    return tomllib.loads("\n".join(f"{key} = {value}" for key, value in lines.items()))


def mission_file_lines(
    mission: Mission, found: Calibration, magnitudes: Mapping[str, Magnitudes]
) -> str:
    """What a calibration changes of a mission file, as TOML."""
    parts = []
    for each in mission.trackers:
        changes = tracker_lines(each, found)
        changes["magnitudes"] = magnitude_lines(magnitudes[each.name], each)
        lines = [f"{key} = {value}" for key, value in changes["tracker"].items()]
        for table in ("calibration", "magnitudes"):
            if changes[table]:
                lines += ["", f"[trackers.{table}]"]
                lines += [f"{key} = {value}" for key, value in changes[table].items()]
        if lines:
            parts.append("\n".join(["[[trackers]]", f'name = "{each.name}"', *lines]))
    return "\n\n".join(parts)
