"""Linking of points to motions; the motion with the most points is taken first.

The points are unmatched stars of batches with an attitude, as inertial directions.

A motion is accepted by an a contrario test (Desolneux, Moisan and Morel 2000): the expected number
of motions with as many points as near, if points lay anywhere, among all pairs that a motion could
begin with, must be below `MOST_EXPECTED`.
"""

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.features.tracks.kernels import (
    GATE,
    MOST_CHANCE,
    Sightings,
    count_seeds,
    extend,
    try_seeds,
)
from service.missions.mission import Tracker
from service.observations.batch import ObservationBatch, TrackerStars
from service.observations.calibrate import CorrectedObservations
from service.observations.focal_plane import tracker_vectors
from service.sky.ephemeris import natural, observer_velocity
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector, unit

_NAMES = (
    *("batch", "tracker", "number", "time_s", "direction", "covariance"),
    *("place", "sigma_rad", "magnitude_mag"),
)
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Batches:
    """Batches (b) with an attitude, in order of time.

    `position_km` (b, 3) is geocentric, NaN where the batch gives none.  `id` are results.
    """

    time: tuple[Utc, ...]
    position_km: Vector
    id: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Points:
    """Observed points (n) without a catalog star, in order of their batches.

    `batch` (n,) is the index of the point's batch, `tracker` (n,) that of its tracker in
    `trackers`, `number` (n,) its place among the tracker's stars, from 0.  `time_s` (n,) is the
    point's time after the first batch.  `direction` (n, 3) is inertial, aberration removed if the
    batch asks for that; `covariance` (n, 3, 3), rad^2, has the noise of the point and of the
    attitude.  `place` (n, 3) is the direction in tracker axes as measured, with `sigma_rad` (n,)
    per tangent axis.  `magnitude_mag` (n,) is NaN if unknown.
    """

    trackers: tuple[str, ...]
    field_sr: Vector
    """Solid angle of each tracker's field of view, (t,), in steradians."""
    batch: Indices
    tracker: Indices
    number: Indices
    time_s: Vector
    direction: Vector
    covariance: Vector
    place: Vector
    sigma_rad: Vector
    magnitude_mag: Vector

    def __len__(self) -> int:
        return len(self.batch)

    def taken(self, chosen: Indices) -> "Points":
        """Points selected by ascending indices."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _NAMES})

    def per_steradian(self) -> Vector:
        """Density (n,) of starless points in each point's batch and tracker, per steradian."""
        own = self.batch * len(self.trackers) + self.tracker
        _, inverse, count = np.unique(own, return_inverse=True, return_counts=True)
        return np.asarray(count[inverse] / self.field_sr[self.tracker])


@dataclass
class Gathering:
    """Collects unmatched points of batches in order of time, for linking."""

    trackers: Sequence[Tracker]
    _times: list[Utc] = field(default_factory=list)
    _positions: list[Vector] = field(default_factory=list)
    _ids: list[str] = field(default_factory=list)
    _parts: list[dict[str, npt.NDArray[np.generic]]] = field(default_factory=list)

    def add(
        self,
        batch: ObservationBatch,
        corrected: Sequence[CorrectedObservations],
        unexplained: Sequence[Indices],
        attitude: Matrix,
        covariance_arcsec2: Matrix,
        id: str = "",
    ) -> None:
        """Add a batch with its attitude (3, 3) and the attitude's covariance in body axes.

        `unexplained` are the indices of the unmatched stars of each tracker, in the batch's order.
        """
        self._times.append(batch.time)
        unknown = np.full(3, np.nan)
        self._positions.append(unknown if batch.position_km is None else batch.position_km)
        self._ids.append(id)
        names = [each.name for each in self.trackers]
        for sent, seen, own in zip(batch.observations, corrected, unexplained, strict=True):
            if len(own):
                part = _carried(batch, sent, seen, own, attitude, covariance_arcsec2)
                seconds = (batch.time.tai_ns - self._times[0].tai_ns) * 1e-9
                part["time_s"] = seconds + sent.time_offset_s[own]
                part["batch"] = np.full(len(own), len(self._times) - 1)
                part["tracker"] = np.full(len(own), names.index(sent.tracker))
                self._parts.append(part)

    @property
    def batches(self) -> Batches:
        """The batches added so far."""
        positions = np.array(self._positions).reshape(-1, 3)
        return Batches(tuple(self._times), positions, tuple(self._ids))

    @property
    def points(self) -> Points:
        """The unmatched points of all batches added so far."""
        fields_sr = 2.0 * np.pi * (1.0 - np.array([each.least_cosine for each in self.trackers]))
        names = tuple(each.name for each in self.trackers)
        if not self._parts:
            whole, single = np.zeros(0, np.int64), np.zeros(0)
            triple = np.zeros((0, 3))
            return Points(
                *(names, fields_sr, whole, whole, whole, single, triple),
                *(np.zeros((0, 3, 3)), triple, single, single),
            )
        return Points(
            names,
            fields_sr,
            **{name: np.concatenate([each[name] for each in self._parts]) for name in _NAMES},
        )


def _carried(
    batch: ObservationBatch,
    sent: TrackerStars,
    seen: CorrectedObservations,
    own: Indices,
    attitude: Matrix,
    covariance_arcsec2: Matrix,
) -> dict[str, npt.NDArray[np.generic]]:
    """Inertial directions of points with covariances, and their directions in tracker axes."""
    body = seen.direction_body[own]
    direction = body @ attitude
    if batch.aberration == "to_correct":
        velocity_c = observer_velocity(batch.time, batch.velocity_km_per_s)
        direction = natural(direction, velocity_c, batch.time)
    # An attitude that is off by the rotation e moves a direction b by b x e, or e x b.
    across = np.cross(body[:, None, :], np.eye(3)[None, :, :])
    of_attitude = across.transpose(0, 2, 1) @ (covariance_arcsec2 / ARCSEC_PER_RADIAN**2) @ across
    square = seen.sigma_rad[own, None, None] ** 2
    of_point = square * (np.eye(3) - body[:, :, None] * body[:, None, :])
    vector = sent.vector[own]
    from_angles = tracker_vectors(sent.angles_deg[own], seen.tracker.calibration)
    return {
        "number": own,
        "direction": direction,
        "covariance": attitude.T @ (of_attitude + of_point) @ attitude,
        "place": np.where(np.isnan(vector), from_angles, vector),
        "sigma_rad": seen.sigma_rad[own],
        "magnitude_mag": seen.magnitude_mag[own],
    }


LEAST_POINTS = 4
REACH = 3
"""Greatest number of batches between the two points with which a search for a motion starts."""
MOST_EXPECTED = 1e-4
MOST_SEEDS = 3_000_000
MOST_RATE_RAD_PER_S = 120.0 / ARCSEC_PER_RADIAN
_ROUNDS = 8

Marks = npt.NDArray[np.bool_]


# A direction that moves along a great circle at a constant rate, fitted to points.
#
# The parameters are a direction and a rate at one moment.  Along the circle a point is off
# by da + t dr; across it by dc cos(w t) + dq sin(w t) / w, where da and dc are errors of the
# direction, dr and dq of the rate, and w is the rate.  These are linear, so that a few rounds of
# weighted least squares settle.


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion along a great circle at constant rate: direction (3,) at `time_s`, rate (3,) in rad/s.

    `axes` (2, 3) are orthonormal and across the direction.  `covariance` (4, 4) is of the
    direction along both, rad^2, then of the rate along both.  Without a rate it is (2, 2).
    `chi_square` has `degrees_of_freedom`.
    """

    time_s: float
    direction: Vector
    rate: Vector
    axes: Matrix
    covariance: Matrix
    chi_square: float
    degrees_of_freedom: int

    def at(self, time_s: Vector) -> tuple[Vector, Vector]:
        """Directions (n, 3) at given times, and the axes (n, 2, 3) transported along the circle."""
        elapsed = np.asarray(time_s) - self.time_s
        speed = float(np.sqrt(self.rate @ self.rate))
        along = self.axes[0] if speed == 0.0 else self.rate / speed
        pole = np.cross(self.direction, along)
        angle = speed * elapsed[:, None]
        place = np.cos(angle) * self.direction + np.sin(angle) * along
        onward = np.cos(angle) * along - np.sin(angle) * self.direction
        # The axes turn about the pole with the direction.
        parts = self.axes @ np.stack([along, pole], axis=1)
        axes = parts[:, 0, None] * onward[:, None, :] + parts[:, 1, None] * pole
        return place, axes

    def spread(self, time_s: Vector) -> Vector:
        """Covariance (n, 2, 2), rad^2, of the directions at given times, on transported axes."""
        elapsed = np.asarray(time_s) - self.time_s
        own = self.covariance
        if len(own) == 2:
            return np.broadcast_to(own, (len(elapsed), 2, 2))
        t = elapsed[:, None, None]
        return np.asarray(own[:2, :2] + t * (own[:2, 2:] + own[2:, :2]) + t * t * own[2:, 2:])

    @property
    def rate_chi_square(self) -> float:
        """Squared rate in sigmas: chi-square with two degrees of freedom for an object at rest."""
        along = self.axes @ self.rate
        return float(along @ np.linalg.solve(self.covariance[2:, 2:], along))


def fit_motion(time_s: Vector, direction: Vector, covariance: Vector, *, moves: bool) -> Motion:
    """Fit a motion to points: times (n,), directions (n, 3), covariances (n, 3, 3) in rad^2.

    A motion with a rate needs two points at different times.
    """
    middle = 0.5 * float(np.min(time_s) + np.max(time_s))
    place, rate = unit(direction.sum(axis=0)), np.zeros(3)
    if moves:
        elapsed = time_s - time_s.mean()
        rate = elapsed @ direction / (elapsed @ elapsed)
        place = unit(place + rate * (middle - float(time_s.mean())))
        rate = rate - (rate @ place) * place
    for _ in range(4):
        axes = _axes(place, rate)
        step, normal, left = _step(
            Motion(middle, place, rate, axes, np.eye(4), 0.0, 0),
            *(time_s, direction, covariance),
            moves=moves,
        )
        place = unit(place + step[:2] @ axes)
        if moves:
            rate = rate + step[2:] @ axes
            rate = rate - (rate @ place) * place
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return Motion(middle, place, rate, axes, covariance, left, 2 * len(time_s) - len(normal))


def offsets(motion: Motion, points: "tuple[Vector, Vector, Vector]") -> tuple[Vector, Vector]:
    """Offsets (n, 2) in rad of directions from a motion, and their variances.

    The variances (n, 2, 2) are of the points alone; both are along the transported axes.
    """
    time_s, direction, covariance = points
    _, axes = motion.at(time_s)
    off = np.einsum("nij,nj->ni", axes, direction)
    return off, np.einsum("nij,njk,nlk->nil", axes, covariance, axes)


def _axes(place: Vector, rate: Vector) -> Matrix:
    """Tangent axes at a direction: along the motion (any axis at rest), and across it."""
    along = rate
    if not rate.any():
        along = np.cross(place, np.eye(3)[int(np.argmin(np.abs(place)))])
    along = unit(along - (along @ place) * place)
    return np.stack([along, np.cross(place, along)])


def _step(
    motion: Motion, time_s: Vector, direction: Vector, covariance: Vector, *, moves: bool
) -> tuple[Vector, Matrix, float]:
    """Correction of one least-squares step, the normal matrix, and the remaining chi-square."""
    off, variance = offsets(motion, (time_s, direction, covariance))
    elapsed = time_s - motion.time_s
    design = np.zeros((len(time_s), 2, 4 if moves else 2))
    design[:, 0, 0] = 1.0
    design[:, 1, 1] = 1.0
    if moves:
        angle = float(np.sqrt(motion.rate @ motion.rate)) * elapsed
        design[:, 1, 1] = np.cos(angle)
        design[:, 0, 2] = elapsed
        design[:, 1, 3] = elapsed * np.sinc(angle / np.pi)
    weight = np.linalg.inv(variance)
    normal = np.einsum("nki,nkl,nlj->ij", design, weight, design)
    right = np.einsum("nki,nkl,nl->i", design, weight, off)
    # Rates are small numbers beside directions: scaled, the matrix is well conditioned.
    scale = np.sqrt(np.diagonal(normal))
    step = np.linalg.solve(normal / np.outer(scale, scale), right / scale) / scale
    left = off - design @ step
    return step, normal, float(np.einsum("nk,nkl,nl->", left, weight, left))


@dataclass(frozen=True, eq=False)
class Link:
    """A motion with the indices of its points, and the expected number of chance ones like it."""

    motion: Motion
    own: Indices
    log10_expected: float


def link(points: Points, batches: int, *, rests: bool = False) -> Iterator[Link]:
    """Link points to motions, the one with the most points first; a point belongs to one at most.

    With `rests` only points at rest are linked, in the axes of the given directions.  Raises
    `BadInput` if there are too many points to try all pairs.
    """
    if len(points) < LEAST_POINTS:
        return
    first = np.searchsorted(points.batch, np.arange(batches + 1))
    pairs = int(count_seeds(first, REACH))
    if pairs > MOST_SEEDS:
        message = f"has too many unexplained points: {len(points):,}; choose a shorter one"
        raise BadInput(Fault("start", f"the period {message}"))
    density = points.per_steradian()
    used = np.zeros(len(points), np.bool_)
    chosen = np.full(batches, -1)
    seen = Sightings(
        *(first, points.batch, points.time_s, points.direction),
        *(_worse_variance(points), density, used, chosen),
    )
    seeds = np.empty((max(pairs, 1), 3), np.int64)
    room = 0.0 if rests else math.pi
    found = int(try_seeds(REACH, MOST_RATE_RAD_PER_S, room, LEAST_POINTS, seen, seeds))
    heap = [(-count, i, j) for i, j, count in seeds[:found].tolist()]
    heapq.heapify(heap)
    while heap:
        count, i, j = heapq.heappop(heap)
        if used[i] or used[j]:
            continue
        now = int(extend(i, j, seen))
        if now < LEAST_POINTS:
            continue
        if now < -count:
            # Some of its points are on another motion by now.
            heapq.heappush(heap, (-now, i, j))
            continue
        own = chosen[points.batch[i] : _end(points, i, chosen, now)]
        made = _settled(points, own[own >= 0], used, density, moves=True)
        if made is not None and rests:
            if made[0].rate_chi_square >= GATE:
                continue
            made = _settled(points, made[1], used, density, moves=False)
        if made is None:
            continue
        motion, own = made
        expected = _log10_expected(points, motion, own, density, pairs)
        if expected < math.log10(MOST_EXPECTED):
            used[own] = True
            yield Link(motion, own, expected)


def _end(points: Points, i: int, chosen: Indices, count: int) -> int:
    """Index after the last batch with a point of a motion; later entries of `chosen` are stale."""
    taken = np.flatnonzero(chosen[points.batch[i] :] >= 0)
    return int(points.batch[i] + taken[count - 1] + 1)


def _worse_variance(points: Points) -> Vector:
    """Variance (n,) of each direction along its worse axis, rad^2."""
    return np.ascontiguousarray(np.linalg.eigvalsh(points.covariance)[:, 2])


def _settled(
    points: Points,
    own: Indices,
    used: Marks,
    density: Vector,
    *,
    moves: bool,
) -> tuple[Motion, Indices] | None:
    """Alternate fitting a motion and collecting its points until stable; None: too few points."""
    motion = None
    for _ in range(_ROUNDS):
        if len(own) < LEAST_POINTS:
            return None
        motion = fit_motion(
            *(points.time_s[own], points.direction[own], points.covariance[own]), moves=moves
        )
        gathered = _gathered(points, motion, used, density)
        if np.array_equal(gathered, own):
            return motion, own
        own = gathered
    return None if motion is None or len(own) < LEAST_POINTS else (motion, own)


def _gathered(
    points: Points,
    motion: Motion,
    used: Marks,
    density: Vector,
) -> Indices:
    """Points on a motion: in each batch and tracker the nearest one within the gate."""
    off, variance = offsets(motion, (points.time_s, points.direction, points.covariance))
    place, _ = motion.at(points.time_s)
    whole = variance + motion.spread(points.time_s)
    distance = np.einsum("ni,nij,nj->n", off, np.linalg.inv(whole), off)
    chance = math.pi * GATE * np.sqrt(np.linalg.det(whole)) * density
    near = ~used & (distance < GATE) & (chance < MOST_CHANCE)
    near &= np.sum(place * points.direction, axis=1) > 0.5
    candidates = np.flatnonzero(near)
    order = candidates[np.argsort(distance[candidates], kind="stable")]
    view = points.batch[order] * len(points.trackers) + points.tracker[order]
    _, nearest = np.unique(view, return_index=True)
    return np.sort(order[nearest])


def _log10_expected(
    points: Points, motion: Motion, own: Indices, density: Vector, pairs: int
) -> float:
    """Log10 of the number of motions with as many points expected among random points."""
    time_s = points.time_s[own]
    _, variance = offsets(motion, (time_s, points.direction[own], points.covariance[own]))
    whole = variance + motion.spread(time_s)
    area = math.pi * GATE * np.sqrt(np.linalg.det(whole))
    chance = np.minimum(area * density[own], 1.0)
    # Two points define the motion and are no evidence: leave out the two most significant.
    log = np.sort(np.log(chance))[2:].sum()
    spanned = int(points.batch[own[-1]] - points.batch[own[0]]) + 1
    free, taken = max(spanned - 2, len(own) - 2), len(own) - 2
    choices = math.lgamma(free + 1) - math.lgamma(taken + 1) - math.lgamma(free - taken + 1)
    return float((log + choices) / math.log(10.0) + math.log10(max(pairs, 1)))
