"""Alignment and focal plane of a mission's trackers: taken out, calibrated, and put in."""

import hashlib
import tomllib
from collections.abc import Sequence
from typing import Any

import msgspec

from service.calibration.estimate import Calibration
from service.calibration.mission_file import Lines, tracker_lines
from service.missions.mission import Calibration as FocalPlaneSettings
from service.missions.mission import Mission, Tracker
from service.storage.calibrations.models import FocalPlane, TrackerGeometry


def geometry_of(tracker: Tracker) -> TrackerGeometry:
    """Alignment and focal plane of a tracker."""
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
    )


def geometry_digest(mission: Mission) -> str:
    """`sha256:` of the alignments and focal planes of all trackers, and of nothing else."""
    text = msgspec.json.encode([geometry_of(each) for each in mission.trackers])
    return "sha256:" + hashlib.sha256(text).hexdigest()


def with_geometry(mission: Mission, trackers: Sequence[TrackerGeometry]) -> Mission:
    """The mission with other alignments and focal planes; trackers not named stay as they are."""
    named = {each.name: each for each in trackers}
    changed = tuple(
        _with(each, named[each.name]) if each.name in named else each for each in mission.trackers
    )
    return mission.model_copy(update={"trackers": changed})


def _with(tracker: Tracker, geometry: TrackerGeometry) -> Tracker:
    settings = {
        **tracker.model_dump(exclude={"camera"}),
        **msgspec.to_builtins(geometry),
        "camera": tracker.camera,
    }
    return Tracker.model_validate(settings)


def calibrated_geometry(mission: Mission, found: Calibration) -> list[TrackerGeometry]:
    """Every tracker of a mission with what a calibration changes of it."""
    return [_calibrated(each, tracker_lines(each, found)) for each in mission.trackers]


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


def mission_file_lines(mission: Mission, found: Calibration) -> str:
    """What a calibration changes of a mission file, as TOML."""
    parts = []
    for each in mission.trackers:
        changes = tracker_lines(each, found)
        lines = [f"{key} = {value}" for key, value in changes["tracker"].items()]
        if changes["calibration"]:
            lines += ["", "[trackers.calibration]"]
            lines += [f"{key} = {value}" for key, value in changes["calibration"].items()]
        if lines:
            parts.append("\n".join(["[[trackers]]", f'name = "{each.name}"', *lines]))
    return "\n\n".join(parts)
