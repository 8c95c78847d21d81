"""The unknowns that a calibration may estimate of each tracker, with their names and units.

Constants and the rotation of a tracker's distortion are its alignment, and the
alignment and clock of the first tracker are the attitude's own.  They are left out
of the list, which fixes the gauge: no constraint has to be carried along.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from service.errors import BadInput, Fault, shown_value
from service.missions.mission import Tracker
from service.vectors import ARCSEC_PER_RADIAN

Kind = Literal["alignment", "scale", "distortion", "temperature", "time_tag"]

LARGEST_DEGREE = 7
STRETCH, SKEW = "stretch", "skew"


@dataclass(frozen=True)
class Model:
    """The unknowns of a calibration.

    `degree` is that of the distortion, 2-D Legendre polynomials; below 1 there is none.
    With a `reference_temperature_c` alignment, scale and the linear distortion change with
    the temperature, and the other unknowns are those at the reference.  With
    `attitudes_known` the batches' attitudes are not estimated: the alignment of every
    tracker to the body is an unknown.  Raises `BadInput` for a degree that is too large.
    """

    alignment: bool = True
    scale: bool = True
    degree: int = 3
    reference_temperature_c: float | None = None
    time_tag: bool = False
    attitudes_known: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.degree <= LARGEST_DEGREE:
            message = f"must be from 0 to {LARGEST_DEGREE}"
            raise BadInput(Fault("degree", message, shown_value(self.degree)))


@dataclass(frozen=True)
class Unknown:
    """One number that is estimated of a tracker.

    `term` is the body axis of an alignment; of a distortion `stretch` (h by x, v by -y),
    `skew` (h by y, v by x), or the angle and the two degrees: ("h", 2, 1) adds
    P2(x) P1(y) to h.  A dependence on temperature has the kind it changes in
    `of`.  `unit` is that of values given outside, `per_unit` the value of one such unit
    inside, in radians and seconds.  `degree` is 0 where it is none of the distortion.
    """

    tracker: int
    kind: Kind
    name: str
    term: tuple[str, int, int]
    unit: str
    per_unit: float
    degree: int = 0
    of: Kind | None = None

    @property
    def shape(self) -> Kind:
        """What the unknown changes, at a temperature or at all."""
        return self.of or self.kind


PLAUSIBLE: dict[Kind, float] = {
    "alignment": 3600.0,
    "scale": 0.1,
    "distortion": 3600.0,
    "time_tag": 1.0,
}
"""In the unit of each kind: stars that leave a sigma beyond it do not show the unknown."""
PLAUSIBLE_CHANGE_C = 100.0
"""Over a change by so many degrees a dependence on temperature is held against these."""
ARCSEC = 1.0 / ARCSEC_PER_RADIAN


def largest_sigma(unknown: Unknown) -> float:
    """The sigma, in the unknown's unit, beyond which it counts as not observable."""
    per_degree = PLAUSIBLE_CHANGE_C if unknown.of is not None else 1.0
    return PLAUSIBLE[unknown.shape] / per_degree


def unknowns_of(trackers: Sequence[Tracker], model: Model) -> list[Unknown]:
    """Every unknown of a model, tracker by tracker; those of one kind follow each other."""
    found: list[Unknown] = []
    for index, tracker in enumerate(trackers):
        free = index > 0 or model.attitudes_known
        own = _alignment(index, tracker.name) if model.alignment and free else []
        if model.scale:
            own.append(Unknown(index, "scale", f"{tracker.name} scale", ("", 0, 0), "1", 1.0))
        own += _distortion(index, tracker.name, model.degree)
        if model.reference_temperature_c is not None:
            shifts = _alignment(index, tracker.name) if free else []
            scale = Unknown(index, "scale", f"{tracker.name} scale", ("", 0, 0), "1", 1.0)
            linear = _distortion(index, tracker.name, min(model.degree, 1))
            own += [_with_temperature(each) for each in (*shifts, scale, *linear)]
        if model.time_tag and free:
            own.append(Unknown(index, "time_tag", f"{tracker.name} time tag", ("", 0, 0), "s", 1.0))
        found += own
    return found


def _alignment(index: int, name: str) -> list[Unknown]:
    return [
        Unknown(index, "alignment", f"{name} alignment {axis}", (axis, 0, 0), "arcsec", ARCSEC)
        for axis in "xyz"
    ]


def _distortion(index: int, name: str, degree: int) -> list[Unknown]:
    """Scale and rotation left out of the linear terms, the constants altogether."""
    terms: list[tuple[str, int, int]] = []
    if degree >= 1:
        terms += [(STRETCH, 1, 0), (SKEW, 0, 1)]
    for total in range(2, degree + 1):
        terms += [(angle, total - j, j) for j in range(total + 1) for angle in "hv"]
    return [
        Unknown(index, "distortion", _called(name, term), term, "arcsec", ARCSEC, term[1] + term[2])
        for term in terms
    ]


def _called(tracker: str, term: tuple[str, int, int]) -> str:
    kind, i, j = term
    return f"{tracker} {kind}" if kind in (STRETCH, SKEW) else f"{tracker} {kind} P{i}(x) P{j}(y)"


def _with_temperature(unknown: Unknown) -> Unknown:
    return Unknown(
        unknown.tracker,
        "temperature",
        f"{unknown.name} per deg C",
        unknown.term,
        f"{unknown.unit}/deg C" if unknown.unit != "1" else "1/deg C",
        unknown.per_unit,
        unknown.degree,
        unknown.kind,
    )
