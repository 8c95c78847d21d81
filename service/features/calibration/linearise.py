"""Residuals of identified stars, and their derivatives by attitudes and calibration unknowns.

A star's residual is observed minus predicted along two tangents, in sigmas.  Observed is the
direction of the measured angles after calibration and correction; predicted is

    p = M^T exp(-[e x]) exp(-[w (t + tau) x]) A r,

r the catalog direction, A the batch's attitude, w its body rates, t the star's time from
the batch's and tau the tracker's time-tag offset, M the mission's alignment and e the
misalignment.  All derivatives are analytic.

Of the unknowns, constants and the rotation of a tracker's distortion are its alignment, and
the alignment and clock of the first tracker are the attitude's own.  They are left out
of the list, which fixes the gauge: no constraint has to be carried along.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import legvander

from service.errors import BadInput, Fault, shown_value
from service.features.calibration.stars import IdentifiedStars, Indices
from service.missions.mission import Tracker
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector, rotate_about

Kind = Literal["alignment", "scale", "distortion", "temperature", "time_tag"]

LARGEST_DEGREE = 7
STRETCH, SKEW = "stretch", "skew"


@dataclass(frozen=True)
class Model:
    """Choice of the unknowns that a calibration estimates.

    `degree` is the degree of the distortion, in 2-D Legendre polynomials; 0 for none.  With a
    `reference_temperature_c` alignment, scale and the linear distortion depend on temperature, and
    the other unknowns are the values at the reference.  With `attitudes_known` the attitudes of
    batches are not estimated: the alignment of every tracker to the body is an unknown.  Raises
    `BadInput` for a degree that is too large.
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
    """One estimated parameter of a tracker.

    `term` is the body axis of an alignment; for a distortion `stretch` (h by x, v by -y), `skew` (h
    by y, v by x), or the angle and the two degrees: ("h", 2, 1) adds P2(x) P1(y) to h.  A
    dependence on temperature has the changed kind in `of`.  `unit` is the unit shown to users,
    `per_unit` one such unit in radians or seconds.  `degree` is 0 unless the parameter belongs to
    the distortion.
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
        """Kind of parameter that an unknown changes, directly or by temperature."""
        return self.of or self.kind


PLAUSIBLE: dict[Kind, float] = {
    "alignment": 3600.0,
    "scale": 0.1,
    "distortion": 3600.0,
    "time_tag": 1.0,
}
"""Largest sigma, in the unit of each kind, with which an unknown still counts as observable."""
PLAUSIBLE_CHANGE_C = 100.0
"""Change of temperature, in degrees C, over which a temperature coefficient is judged."""
ARCSEC = 1.0 / ARCSEC_PER_RADIAN


def largest_sigma(unknown: Unknown) -> float:
    """Sigma, in the unit of the unknown, above which it counts as not observable."""
    per_degree = PLAUSIBLE_CHANGE_C if unknown.of is not None else 1.0
    return PLAUSIBLE[unknown.shape] / per_degree


def unknowns_of(trackers: Sequence[Tracker], model: Model) -> list[Unknown]:
    """Unknowns of a calibration model, tracker by tracker and grouped by kind."""
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
    """Distortion unknowns up to a degree, without constants, scale and rotation."""
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


Weights = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackerStars:
    """Fixed data of one tracker's stars (n) during a calibration, independent of the unknowns.

    `rows` are the places of the stars among all stars, `columns` (q,) those of the tracker's
    unknowns among all unknowns.  `tangent` (n, 2, 3) are the two directions, in tracker axes, along
    which residuals are taken.  `bending` are the unknowns that change the angles, each with its
    place and the change of h and of v (n,) per radian.  `temperature_c` counts from the reference.
    """

    tracker: Tracker
    unknowns: tuple[Unknown, ...]
    columns: Indices
    rows: slice
    batch: Indices
    angles_rad: Vector
    reference: Vector
    sigma_rad: Vector
    time_offset_s: Vector
    temperature_c: Vector
    rates_rad_per_s: Vector
    tangent: Vector
    bending: tuple[tuple[int, Vector, Vector], ...]

    def places(self, *kinds: str, of_temperature: bool = False) -> list[int]:
        """Indices of the tracker's unknowns of the given kinds, among its own."""
        return [
            place
            for place, each in enumerate(self.unknowns)
            if each.shape in kinds and (each.of is not None) == of_temperature
        ]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Derivatives of one tracker's residuals (2, n), in sigmas.

    `by_unknown` (q, 2, n) is by the tracker's unknowns, in radians and seconds;
    `by_attitude` (n, 2, 3) by a small rotation d of the batch's attitude about the body
    axes, A -> exp(-[d x]) A.
    """

    stars: TrackerStars
    by_unknown: Vector
    by_attitude: Vector

    @property
    def flat(self) -> Vector:
        """Derivatives of residuals by the unknowns, reshaped to a matrix (q, 2 n)."""
        count, angles, n = self.by_unknown.shape
        return self.by_unknown.reshape(count, angles * n)

    @cached_property
    def by_turns(self) -> Any:
        """Derivatives by attitudes as a sparse matrix (2 n, 3 K), K up to the last batch."""
        from scipy.sparse import csr_array

        n = len(self.stars.batch)
        columns = 3 * self.stars.batch[:, None] + np.arange(3)
        data = np.swapaxes(self.by_attitude, 0, 1).ravel()
        return csr_array(
            (data, np.tile(columns.ravel(), 2), np.arange(0, 6 * n + 1, 3)),
            shape=(2 * n, 3 * (int(self.stars.batch[-1]) + 1)),
        )


def prepared(
    stars: IdentifiedStars, unknowns: Sequence[Unknown], reference_temperature_c: float | None
) -> list[TrackerStars]:
    """Group stars by tracker for a calibration, without empty trackers; sorted as by `usable`."""
    from_c = 0.0 if reference_temperature_c is None else reference_temperature_c
    edges = np.searchsorted(stars.tracker, np.arange(len(stars.trackers) + 1))
    return [
        _of_tracker(stars, index, slice(int(first), int(last)), unknowns, from_c)
        for index, (first, last) in enumerate(pairwise(edges))
        if last > first
    ]


def _of_tracker(
    stars: IdentifiedStars, index: int, rows: slice, unknowns: Sequence[Unknown], from_c: float
) -> TrackerStars:
    tracker = stars.trackers[index]
    columns = [place for place, each in enumerate(unknowns) if each.tracker == index]
    own = tuple(unknowns[place] for place in columns)
    batch = stars.batch[rows]
    radius_rad = np.radians(tracker.field_of_view_radius_deg)
    # Where the temperature is not known, the reference is the best guess.
    temperature_c = np.nan_to_num(stars.temperature_c[rows] - from_c, nan=0.0)
    x, y = (stars.measured_rad[rows] / radius_rad).T
    vander = np.moveaxis(
        legvander(np.stack([x, y]), max((each.degree for each in own), default=0)), 2, 1
    ).copy()
    bending = []
    for place, each in enumerate(own):
        if each.shape in ("scale", "distortion"):
            by_h, by_v = _bend(each, x, y, vander, radius_rad)
            if each.of is not None:
                by_h, by_v = by_h * temperature_c, by_v * temperature_c
            bending.append((place, by_h, by_v))
    angles = stars.angles_rad[rows]
    return TrackerStars(
        tracker,
        own,
        np.array(columns, dtype=np.int64),
        rows,
        batch,
        angles,
        stars.reference[rows],
        stars.sigma_rad[rows],
        stars.time_offset_s[rows],
        temperature_c,
        stars.rates_rad_per_s[batch],
        _tangents(directions(angles)),
        tuple(bending),
    )


def _bend(
    unknown: Unknown, x: Vector, y: Vector, vander: Vector, radius_rad: float
) -> tuple[Vector, Vector]:
    """Change of h and of v per unit of an unknown; `vander` (2, degree + 1, n) are P(x) and P(y).

    A distortion of one radian moves a star at the edge of the field by one radian.
    """
    kind, i, j = unknown.term
    if unknown.shape == "scale":
        return x * radius_rad, y * radius_rad
    if kind == STRETCH:
        return x, -y
    if kind == SKEW:
        return y, x
    bent, none = vander[0, i] * vander[1, j], np.zeros_like(x)
    return (bent, none) if kind == "h" else (none, bent)


def directions(angles_rad: Vector) -> Vector:
    """Unit vectors (n, 3) in tracker axes from undistorted angles h, v (n, 2)."""
    tangents = np.tan(angles_rad)
    z = 1.0 / np.sqrt(1.0 + np.sum(tangents**2, axis=1))
    return np.column_stack([tangents * z[:, None], z])


def _tangents(direction: Vector) -> Vector:
    """Two tangent unit vectors (n, 2, 3) of each direction, right-handed; the first along h."""
    x, y, z = direction.T
    across = np.hypot(y, z)
    zero = np.zeros_like(x)
    first = np.stack([across, -x * y / across, -x * z / across], axis=1)
    second = np.stack([zero, z / across, -y / across], axis=1)
    return np.stack([first, second], axis=1)


def _corrected_angles(stars: TrackerStars, values: Vector) -> Vector:
    """Measured angles h, v (n, 2) with scale and distortion corrections from the unknowns (p,)."""
    own, angles = values[stars.columns], stars.angles_rad.copy()
    for place, by_h, by_v in stars.bending:
        if own[place]:
            angles[:, 0] += own[place] * by_h
            angles[:, 1] += own[place] * by_v
    return angles


def _predicted(stars: TrackerStars, values: Vector, attitude: Matrix) -> tuple[Vector, Matrix]:
    """Catalog directions (n, 3) in tracker axes, and the misaligned rotation to body axes."""
    own = values[stars.columns]
    aligned = stars.places("alignment")
    turned = own[aligned] if aligned else np.zeros(3)
    body_from_tracker = rotate_about(turned, stars.tracker.body_from_tracker.T).T
    tag = stars.places("time_tag")
    after_s = stars.time_offset_s + (own[tag[0]] if tag else 0.0)
    turn = -stars.rates_rad_per_s * after_s[:, None]
    body = np.einsum("nij,nj->ni", attitude[stars.batch], stars.reference)
    if turn.any():
        body = rotate_about(turn, body)
    drift = stars.places("alignment", of_temperature=True)
    if drift:
        body = rotate_about(-own[drift] * stars.temperature_c[:, None], body)
    return body @ body_from_tracker, body_from_tracker


def residuals(stars: TrackerStars, values: Vector, attitude: Matrix) -> Vector:
    """Residuals, observed minus predicted direction, (2, n) in sigmas along two tangents.

    `values` (p,) are all unknowns in radians and seconds, `attitude` (K, 3, 3) the attitudes of the
    batches.
    """
    observed = directions(_corrected_angles(stars, values))
    predicted, _ = _predicted(stars, values, attitude)
    apart = observed - predicted
    return np.asarray(np.einsum("nri,ni->rn", stars.tangent, apart) / stars.sigma_rad)


def linearised(stars: TrackerStars, values: Vector, attitude: Matrix) -> Linearised:
    """Derivatives of a tracker's residuals by unknowns and attitudes."""
    own = values[stars.columns]
    predicted, body_from_tracker = _predicted(stars, values, attitude)
    angles = _corrected_angles(stars, values)
    # A small turn d of the body, d in body axes, changes t.(u - p) by d.M(p x t).
    turning = np.cross(predicted[:, None, :], stars.tangent) @ body_from_tracker.T
    turning /= stars.sigma_rad[:, None, None]
    by_unknown = np.empty((len(own), 2, len(predicted)))
    bent = _by_angles(stars, angles)
    for place, by_h, by_v in stars.bending:
        np.multiply(bent[0], by_h, out=by_unknown[place])
        by_unknown[place] += bent[1] * by_v
    aligned = stars.places("alignment")
    if aligned:
        by_unknown[aligned] = (turning @ _left_jacobian(own[aligned])).transpose(2, 1, 0)
    drift = stars.places("alignment", of_temperature=True)
    if drift:
        by_unknown[drift] = turning.transpose(2, 1, 0) * stars.temperature_c
        drifted = own[drift] * stars.temperature_c[:, None]
        turning = rotate_about(drifted[:, None, :], turning)
    tag = stars.places("time_tag")
    if tag:
        by_unknown[tag[0]] = np.einsum("nri,ni->rn", turning, stars.rates_rad_per_s)
    after_s = stars.time_offset_s + (own[tag[0]] if tag else 0.0)
    to_epoch = stars.rates_rad_per_s * after_s[:, None]
    by_attitude = rotate_about(to_epoch[:, None, :], turning) if to_epoch.any() else turning
    return Linearised(stars, by_unknown, by_attitude)


def _by_angles(stars: TrackerStars, angles_rad: Vector) -> Vector:
    """Derivatives (2, 2, n) of the residuals by the angles h and v."""
    direction = directions(angles_rad)
    slope = direction[:, 2, None] / np.cos(angles_rad) ** 2
    along = np.einsum("nri,ni->nr", stars.tangent, direction)
    # du/d(tan h) = z (e_x - u u_x), u being the direction and z its last part; v likewise.
    by = stars.tangent[:, :, :2] - along[:, :, None] * direction[:, None, :2]
    by *= slope[:, None, :] / stars.sigma_rad[:, None, None]
    return np.ascontiguousarray(by.transpose(2, 1, 0))


def _left_jacobian(rotation_rad: Vector) -> Matrix:
    """Left Jacobian of SO(3), d exp([e x]) / de, to first order in the rotation vector e."""
    x, y, z = rotation_rad
    return np.eye(3) + 0.5 * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turned_attitudes(attitude: Matrix, turn_rad: Vector) -> Matrix:
    """Attitudes (K, 3, 3) after small turns (K, 3): exp(-[d x]) A."""
    rows = rotate_about(-turn_rad[:, None, :], np.swapaxes(attitude, 1, 2))
    return np.swapaxes(rows, 1, 2)
