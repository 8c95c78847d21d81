"""Default values of a mission file, computed from its other values, with their origins.

A file of ten lines names each tracker's field, its errors, its limiting magnitude and the error
of the a priori attitude.  `RULES` derives the rest.  `docs/missions.md` has the same table.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from service.missions.camera import (
    REQUIRED_OF_CAMERAS,
    camera_defaults,
    field_of_camera_deg,
    with_camera_defaults,
)
from service.vectors import Vector

MARGIN_DEG = 0.1
"""Margin of a zone in degrees, for aberration and for stars just outside the field of view."""
LOST_ERROR_DEG = 1.0
"""A priori error in degrees assumed for the zone of a mission without a priori knowledge."""
SUN_ERROR_DEG = 0.1
"""Default error of a Sun-pointed axis in degrees, from the paper."""
SEPARATION_SIGMAS = 11.2
"""Ratio of the paper's SEPTOL to its sigma per axis: 0.0066 deg for 3 arcsec radial."""
MAGNITUDE_SIGMAS = 6.0
"""Ratio of the paper's magnitude tolerances XMTOL and TMAGMX to SIGMAG: 0.6 mag for 0.1 mag."""
POLE_ERRORS = 1.3
"""Ratio of the paper's BANTOL1 to the error of the pole: 0.13 deg for 0.1 deg."""
MERGE_SIGMAS = 20.0 * math.sqrt(2.0)
"""Merging distance of catalog stars over a tracker's sigma per axis, from the shipped missions."""
MERGE_ARCSEC = 60.0, 300.0
POSITION_SIGMA_ARCSEC = 5.0
MAGNITUDE_SIGMA_MAG = 0.1
LARGEST_PAIR_DEG, LARGEST_SEPARATION_DEG = 60.0, 5.0
GRID_SHARE, LARGEST_GRID_DEG = 0.1, 1.0
AXES = ("x_axis_body", "y_axis_body", "z_axis_body")
BODY_AXES = {name: tuple(np.eye(3)[k].tolist()) for k, name in enumerate(AXES)}


class Rule(NamedTuple):
    """The rule for a default of a mission file: its key, an explanation, and its function.

    The function returns None where the rule does not apply to the mission. It may raise the errors
    of `_FAULTY` where a required value is missing or wrong.
    """

    key: str
    says: str
    value: Callable[["Given"], Any]


@dataclass(frozen=True)
class Completed:
    """A mission file's tables completed with defaults.

    `origins` maps the dotted key of a computed value to its rule. `waiting` has the keys that could
    not be computed because a value of the file is missing or wrong.
    """

    table: dict[str, Any]
    origins: dict[str, str] = field(default_factory=dict)
    waiting: frozenset[str] = frozenset()


_FAULTY = (TypeError, ValueError, KeyError, IndexError, ArithmeticError, AttributeError)


class Given:
    """Values of a mission file that defaults are computed from; wrong ones raise `ValueError`."""

    def __init__(self, table: Mapping[str, Any]) -> None:
        self.table = table

    def trackers(self) -> list[dict[str, Any]]:
        """The tables of the mission's trackers, completed with their own defaults."""
        trackers = self.table["trackers"]
        if not trackers:
            raise ValueError("no tracker")
        return list(trackers)

    def corner_deg(self) -> float:
        """Largest angle in degrees from a tracker's boresight to a corner of its field of view."""
        return max(_positive(each["field_of_view_radius_deg"]) for each in self.trackers())

    def largest_sigma_arcsec(self) -> float:
        """The largest position sigma of the trackers, in arcsec."""
        return max(_positive(each["sigma_arcsec"]) for each in self.trackers())

    def magnitude_tolerance_mag(self) -> float:
        """The magnitude tolerance, computed from the largest magnitude sigma of the trackers."""
        sigmas = [_positive(each["magnitude_sigma_mag"]) for each in self.trackers()]
        return min(_rounded(MAGNITUDE_SIGMAS * max(sigmas)), 30.0)

    def sun_axis(self) -> list[float] | None:
        """The body axis that points to the Sun; None for a mission that is not Sun-pointed."""
        axis = self.table.get("sun_pointed_axis_body")
        return None if axis is None else [_number(each) for each in axis]

    def error_deg(self) -> float:
        """The largest a priori attitude error in degrees, as the mission file says or by default.

        It is that about each axis, or of the pole.
        """
        default = LOST_ERROR_DEG if self.sun_axis() is None else SUN_ERROR_DEG
        return _positive(self.table.get("a_priori_error_deg", default))

    def is_short(self) -> bool:
        """True if the file derives its run catalog from the trackers' `limit_mag`."""
        return any("limit_mag" in each for each in self.trackers())

    def zone_kind(self) -> Any:
        """The kind of zone, cap or band, that the file states or implies."""
        implied = "cap" if self.sun_axis() is None else "band"
        return self.table.get("zone", {}).get("kind", implied)


def _zone_radius_deg(given: Given) -> float | None:
    if given.zone_kind() != "cap":
        return None
    error_deg, reach_deg = given.error_deg(), 0.0
    for tracker in given.trackers():
        boresight = _vector(tracker["z_axis_body"])
        # Errors about the axes add; the largest displacement is at a corner of their cube.
        shift = max(float(np.linalg.norm(np.cross(each, boresight))) for each in _CORNERS)
        reach_deg = max(
            reach_deg, _positive(tracker["field_of_view_radius_deg"]) + shift * error_deg
        )
    return min(_up(reach_deg + MARGIN_DEG), 180.0)


_CORNERS = list(product((-1.0, 1.0), repeat=3))


def _half_width_deg(given: Given) -> float | None:
    if given.zone_kind() != "band":
        return None
    return min(_up(given.corner_deg() + given.error_deg() + MARGIN_DEG), 90.0)


def _coelevation_deg(given: Given) -> float | None:
    if given.zone_kind() != "band":
        return None
    return _from_sun_deg(given, given.trackers()[0])


def _grid_deg(given: Given) -> float | None:
    """The grid step of cached zones in degrees; None for a file in the earlier form with a zone."""
    zone = given.table["zone"]
    size_key = "radius_deg" if zone["kind"] == "cap" else "half_width_deg"
    if "sun_pointed_axis_body" not in given.table and "a_priori_error_deg" not in given.table:
        return None
    return max(0.01, min(_rounded(GRID_SHARE * _positive(zone[size_key])), LARGEST_GRID_DEG))


def _limit_mag(given: Given) -> float:
    return max(_number(each["limit_mag"]) for each in given.trackers() if "limit_mag" in each)


def _merge_arcsec(given: Given) -> float | None:
    if not given.is_short():
        return None
    least, most = MERGE_ARCSEC
    return min(max(_rounded(MERGE_SIGMAS * given.largest_sigma_arcsec()), least), most)


def _position_sigma_arcsec(given: Given) -> float | None:
    if not given.is_short():
        return None
    return max(POSITION_SIGMA_ARCSEC, given.largest_sigma_arcsec())


def _pole_difference_deg(given: Given) -> float | None:
    if given.zone_kind() != "band" or "a_priori_error_deg" not in given.table:
        return None
    return min(_rounded(POLE_ERRORS * given.error_deg()), 180.0)


def _identifier(given: Given) -> str | None:
    knows = {"a_priori_error_deg", "sun_pointed_axis_body", "zone"} & given.table.keys()
    return None if knows else "lost_in_space"


_CORNER = "the largest field_of_view_radius_deg"

RULES: tuple[Rule, ...] = (
    Rule(
        "a_priori_error_deg",
        "0.1 deg if sun_pointed_axis_body and limit_mag are given, as in the paper",
        lambda given: SUN_ERROR_DEG if given.is_short() and given.sun_axis() else None,
    ),
    Rule(
        "identifier",
        "lost_in_space if the file states no a priori knowledge, else verified",
        _identifier,
    ),
    Rule(
        "zone.kind",
        "band if sun_pointed_axis_body is given, else cap",
        lambda given: given.zone_kind(),
    ),
    Rule(
        "zone.axis_body",
        "sun_pointed_axis_body, else the boresight of the first tracker",
        lambda given: given.sun_axis() or given.trackers()[0]["z_axis_body"],
    ),
    Rule(
        "zone.radius_deg",
        "of a cap: field_of_view_radius_deg + 1.41 (up to 1.73 for a boresight between the body "
        "axes) times a_priori_error_deg (1 deg if lost in space) + 0.1 deg",
        _zone_radius_deg,
    ),
    Rule(
        "zone.half_width_deg",
        f"of a band: {_CORNER} + a_priori_error_deg (0.1 deg by default) + 0.1 deg",
        _half_width_deg,
    ),
    Rule(
        "zone.coelevation_deg",
        "of a band: the angle from sun_pointed_axis_body to the boresight of the first tracker",
        _coelevation_deg,
    ),
    Rule(
        "zone.grid_deg",
        "a tenth of the zone's radius or half width, at most 1 deg",
        _grid_deg,
    ),
    Rule(
        "tolerances.pair_separation_max_deg",
        f"twice {_CORNER}, at most 60 deg",
        lambda given: min(_rounded(2.0 * given.corner_deg(), 4), LARGEST_PAIR_DEG),
    ),
    Rule(
        "tolerances.separation_deg",
        "11.2 times the largest sigma_arcsec: the paper's 0.0066 deg for 3 arcsec radial",
        lambda given: min(
            _rounded(SEPARATION_SIGMAS * given.largest_sigma_arcsec() / 3600.0),
            LARGEST_SEPARATION_DEG,
        ),
    ),
    Rule(
        "tolerances.magnitude_mag",
        "6 times the largest magnitude_sigma_mag",
        Given.magnitude_tolerance_mag,
    ),
    Rule(
        "tolerances.magnitude_order_mag",
        "6 times the largest magnitude_sigma_mag",
        Given.magnitude_tolerance_mag,
    ),
    Rule(
        "tolerances.cross_product_deg",
        "90, as in the paper",
        lambda given: 90.0,
    ),
    Rule(
        "tolerances.pole_difference_deg",
        "of a band: 1.3 times a_priori_error_deg",
        _pole_difference_deg,
    ),
    Rule(
        "catalog.magnitude_limit_mag",
        "the largest limit_mag",
        _limit_mag,
    ),
    Rule(
        "catalog.merge_within_arcsec",
        "with limit_mag: 28.3 times the largest sigma_arcsec, at least 60 and at most 300 arcsec",
        _merge_arcsec,
    ),
    Rule(
        "catalog.reject_position_sigma_arcsec",
        "with limit_mag: 5 arcsec, or the largest sigma_arcsec if that is more",
        _position_sigma_arcsec,
    ),
)
"""The rules for a mission's defaults, in the order of their computation."""

TRACKER_RULES: Mapping[str, str] = {
    "name": "STARTRACKER_1, STARTRACKER_2, ...",
    "x_axis_body": "body X without any axis; right-handed if the two others are given",
    "y_axis_body": "body Y without any axis; right-handed if the two others are given",
    "z_axis_body": "body Z without any axis; right-handed if the two others are given",
    "field_of_view_deg": "of a camera: its pixels over its focal length",
    "field_of_view_radius_deg": "to the corner of field_of_view_deg, or of the camera's frame",
    "magnitude_sigma_mag": "0.1 mag, as in the paper",
    "coelevation_deg": "of a band: the angle from sun_pointed_axis_body to the boresight",
    "camera": "without a value of its own: as of a file with a table [camera]",
}
"""The tracker keys that a file may leave out, and the rules for their defaults in words."""


def completed(table: dict[str, Any]) -> Completed:
    """A mission file's tables with every default that follows from other values.

    Wrong values are left unchanged: the check of the mission reports them.
    """
    table = with_camera_defaults(table)
    origins: dict[str, str] = {}
    waiting: set[str] = set()
    trackers = table.get("trackers")
    if isinstance(trackers, list):
        table = {**table, "trackers": [*_with_tracker_defaults(table, origins)]}
    for key, says, value_of in RULES:
        group, _, name = key.rpartition(".")
        held = table.get(group, {}) if group else table
        if not isinstance(held, dict) or name in held:
            continue
        try:
            value = value_of(Given(table))
        except _FAULTY:
            waiting.add(key)
            continue
        if value is not None:
            origins[key] = says
            table = {**table, group: {**held, name: value}} if group else {**table, name: value}
    return Completed(table, origins, frozenset(waiting))


def _with_tracker_defaults(table: dict[str, Any], origins: dict[str, str]) -> Iterator[Any]:
    for place, tracker in enumerate(table["trackers"]):
        if not isinstance(tracker, dict):
            yield tracker
            continue
        whole = dict(tracker)
        for fill in (_name, _axes, _camera, _field, _noise, _coelevation):
            try:
                values = fill(table, place, whole)
            except _FAULTY:
                continue
            for name, value in values.items():
                if name == "camera":
                    added = value.keys() - whole["camera"].keys()
                    says = {f"camera.{each}": TRACKER_RULES["camera"] for each in added}
                else:
                    says = {name: TRACKER_RULES[name]}
                origins |= {f"trackers.{place}.{each}": text for each, text in says.items()}
                whole[name] = value
        yield whole


def _name(table: dict[str, Any], place: int, tracker: dict[str, Any]) -> dict[str, Any]:
    return {} if "name" in tracker else {"name": f"STARTRACKER_{place + 1}"}


def _axes(table: dict[str, Any], place: int, tracker: dict[str, Any]) -> dict[str, Any]:
    missing = [name for name in AXES if name not in tracker]
    if len(missing) == len(AXES):
        return dict(BODY_AXES)
    if len(missing) != 1:
        return {}
    k = AXES.index(missing[0])
    first, second = (_vector(tracker[AXES[(k + step) % 3]]) for step in (1, 2))
    # Adding zero removes negative zeros, which would change the text that the mission's digest
    # covers.
    third = np.cross(first, second) + 0.0
    return {missing[0]: third.tolist()}


def _camera(table: dict[str, Any], place: int, tracker: dict[str, Any]) -> dict[str, Any]:
    camera = tracker.get("camera")
    # A file in the earlier form states all of these keys; keys that it omits keep their meaning.
    if not isinstance(camera, dict) or camera.keys() >= REQUIRED_OF_CAMERAS:
        return {}
    return {"camera": camera_defaults(tracker["camera"], tracker.get("field_of_view_deg"))}


def _field(table: dict[str, Any], place: int, tracker: dict[str, Any]) -> dict[str, Any]:
    if "field_of_view_radius_deg" in tracker:
        return {}
    values: dict[str, Any] = {}
    field_deg = tracker.get("field_of_view_deg")
    if field_deg is None:
        field_deg = field_of_camera_deg(tracker["camera"])
        values["field_of_view_deg"] = field_deg
    width_deg, height_deg = (_positive(each) for each in field_deg)
    if max(width_deg, height_deg) >= 120.0:
        raise ValueError("too wide")
    corner = math.hypot(*(math.tan(math.radians(0.5 * each)) for each in (width_deg, height_deg)))
    return {**values, "field_of_view_radius_deg": _up(math.degrees(math.atan(corner)), 3)}


def _noise(table: dict[str, Any], place: int, tracker: dict[str, Any]) -> dict[str, Any]:
    return {} if "magnitude_sigma_mag" in tracker else {"magnitude_sigma_mag": MAGNITUDE_SIGMA_MAG}


def _coelevation(table: dict[str, Any], place: int, tracker: dict[str, Any]) -> dict[str, Any]:
    # The first tracker's coelevation is the zone's.
    is_derived = "coelevation_deg" not in table.get("zone", {})
    if place == 0 or "coelevation_deg" in tracker or not is_derived:
        return {}
    given = Given(table)
    return {} if given.sun_axis() is None else {"coelevation_deg": _from_sun_deg(given, tracker)}


def _from_sun_deg(given: Given, tracker: Mapping[str, Any]) -> float:
    axis, boresight = (
        _vector(components)
        for components in (
            given.sun_axis() or given.table["zone"]["axis_body"],
            tracker["z_axis_body"],
        )
    )
    angle_deg = math.degrees(
        math.atan2(np.linalg.norm(np.cross(axis, boresight)), float(axis @ boresight))
    )
    return _rounded(angle_deg, 5)


def _number(value: Any) -> float:
    """A value checked to be a finite number; raises `ValueError` for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError("no number")
    return float(value)


def _vector(value: Any) -> Vector:
    """A value checked to be a vector of three finite numbers; raises `ValueError` otherwise."""
    first, second, third = (_number(each) for each in value)
    return np.array([first, second, third])


def _positive(value: Any) -> float:
    if (number := _number(value)) <= 0.0:
        raise ValueError("not above zero")
    return number


def _rounded(value: float, digits: int = 2) -> float:
    """A number rounded to a number of significant digits."""
    return float(f"{value:.{digits}g}")


def _up(value: float, decimals: int = 2) -> float:
    """A number rounded up at a number of decimals."""
    scale = 10.0**decimals
    return math.ceil(round(value * scale, 6)) / scale


def needs(table: Mapping[str, Any]) -> Iterator[str]:
    """The missing values of a mission file that defaults depend on, each with an example.

    Values that are present but wrong are reported elsewhere.
    """
    if "camera" in table:
        return
    trackers = table.get("trackers")
    if not trackers:
        yield "trackers: are required: a table [[trackers]] for each star tracker"
        return
    if not isinstance(trackers, list) or not all(isinstance(each, dict) for each in trackers):
        return
    for place, tracker in enumerate(trackers):
        if not {"field_of_view_deg", "field_of_view_radius_deg", "camera"} & tracker.keys():
            yield (
                f"trackers.{place}.field_of_view_deg: is required, such as [8.0, 8.0] (width and "
                "height); or field_of_view_radius_deg, or a table [trackers.camera]"
            )
    catalog = table.get("catalog", {})
    is_limited = any("limit_mag" in each for each in trackers)
    if not is_limited and isinstance(catalog, dict) and "magnitude_limit_mag" not in catalog:
        yield "trackers.0.limit_mag: is required, such as 6.5: the faintest star that it sees"
