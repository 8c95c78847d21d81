"""The input and work arrays of a hypothesis search, as named tuples for kernels.

Vectors are in the presumed frame: inertial axes according to the a priori attitude. The attitude T
of a hypothesis rotates catalog directions to that frame, so that T is the identity where the a
priori attitude is right.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from service.compiled.jit import njit, njit_inlined, njit_no_refcount
from service.sky.geometry.directions import separation_rad

MAX_HYPOTHESES = 2048
"""Number of hypotheses kept in a search, a power of two; lighter ones are only summed."""
PREDICTION_GATE = 20.0
"""Largest distance, in sigmas, of a star from its place predicted by a pair of stars."""
MAX_SEEDS = 12
"""Number of brightest stars whose pairs are scanned; all stars are matched."""


class ObservedStars(NamedTuple):
    """Observed stars (n) of a search: directions, magnitudes (NaN: none), sigmas, and the prior.

    `weight` is (reference_sigma / sigma)^2.  `velocity` of the observer is in
    units of c, zero where aberration is not to be corrected.
    """

    direction: Any
    magnitude: Any
    sigma_rad: Any
    weight: Any
    reference_sigma: Any
    velocity: Any
    prior_kind: Any
    prior_axis: Any


class ZoneStars(NamedTuple):
    """The zone's stars (m) with a search grid, and exact bounds on the angle to the zone's axis.

    `polar` (m,) caches that angle; -1 if not computed yet. `log_density` is the logarithm of the
    stars within the bounds per steradian.
    """

    direction: Any
    magnitude: Any
    grid_start: Any
    grid_rows: Any
    grid_direction: Any
    voxels: Any
    axis: Any
    least: Any
    most: Any
    polar: Any
    log_density: Any


class ZonePairs(NamedTuple):
    """The zone's pair index, as in `sky.geometry.pairs`, with differences of polar angles.

    The polar angles are about the zone's own axis, which is `off_axis` radians from the exact one.
    """

    separation: Any
    brighter: Any
    dimmer: Any
    bin_start: Any
    bins_per_rad: Any
    polar_difference: Any
    off_axis: Any


class Scratch(NamedTuple):
    """Reusable work arrays of a search for n stars.

    For the present hypothesis: `match` (n,) its zone rows, `used` (n,) the zone rows taken so far,
    `nearest` and `second` (n,) the two nearest zone stars at its attitude, `references` (n, 3) the
    apparent directions of its stars, `t` (3, 3) its attitude, `matrix` N and `inverse` (3, 3),
    `smaller` and `turned` (3, 3) both with one star left out. For the present pair: `order` (n +
    1,) the other stars, the best predicted first, their coefficients `parts` (n, 3) and `gate`
    (n,). By number of stars: `weight_bounds` (n + 1,) upper bounds of their weight, NaN if not
    computed, and `deferred_counts` (n + 1,) the candidates not examined. For the s seeds: their
    stars `seeds` (s,) and `group` (s,), `group_of` (n + 1,) by star, and by pair of seeds the range
    of candidates `first_pair` to `last_pair` (s, s), their `separation` and the `cost` (s, s) of
    joining two groups.
    """

    match: Any
    used: Any
    nearest: Any
    second: Any
    references: Any
    t: Any
    matrix: Any
    inverse: Any
    smaller: Any
    turned: Any
    order: Any
    parts: Any
    gate: Any
    weight_bounds: Any
    deferred_counts: Any
    seeds: Any
    group: Any
    group_of: Any
    first_pair: Any
    last_pair: Any
    separation: Any
    cost: Any


class Ledger(NamedTuple):
    """The hypotheses kept by a search: their matches and log weights, in the order found.

    `match` (MAX_HYPOTHESES, n) and `log_weight` (MAX_HYPOTHESES,); `table` finds a match by its
    hash. `heaviest_match` (n,) is the match of the heaviest hypothesis, `heaviest` (1,) its log
    weight, and `heaviest_dropped` (1,) that of the heaviest dropped one.
    """

    match: Any
    log_weight: Any
    table: Any
    heaviest_match: Any
    heaviest: Any
    heaviest_dropped: Any


class Progress(NamedTuple):
    """The immutable progress of a search: counts, best weight, unexplored weight, and work.

    `count` hypotheses are in the ledger. `unexplored_weight` is the log weight of the null
    hypothesis and of all that were dropped. `best` is the heaviest of three or more stars; `work`
    counts stars looked up and fitted, and the search ends at `max_work`.
    """

    count: Any
    unexplored_weight: Any
    best: Any
    work: Any
    max_work: Any


@njit(nogil=True)
def scratch_for(n):  # type: ignore[no-untyped-def]
    """New work arrays for a search of n stars."""
    rows = np.full((4, n), -1, np.int32)
    squares = np.empty((5, 3, 3))
    numbers = np.empty((5, n + 1), np.int64)
    s = min(n, MAX_SEEDS)
    ranges = np.empty((2, s, s), np.int64)
    angles = np.empty((2, s, s))
    return Scratch(
        match=rows[0],
        used=rows[1],
        nearest=rows[2],
        second=rows[3],
        references=np.empty((n, 3)),
        t=squares[0],
        matrix=squares[1],
        inverse=squares[2],
        smaller=squares[3],
        turned=squares[4],
        order=numbers[0],
        parts=np.empty((n, 3)),
        gate=np.empty(n),
        weight_bounds=np.full(n + 1, np.nan),
        deferred_counts=numbers[1],
        seeds=numbers[2, :s],
        group=numbers[3, :s],
        group_of=numbers[4],
        first_pair=ranges[0],
        last_pair=ranges[1],
        separation=angles[0],
        cost=angles[1],
    )


@njit(nogil=True)
def ledger_for(n):  # type: ignore[no-untyped-def]
    """An empty ledger for matches of n stars."""
    extremes = np.full((2, 1), -math.inf)
    return Ledger(
        match=np.empty((MAX_HYPOTHESES, n), np.int32),
        log_weight=np.empty(MAX_HYPOTHESES),
        table=np.empty(2 * MAX_HYPOTHESES, np.int32),
        heaviest_match=np.full(n, -1, np.int32),
        heaviest=extremes[0],
        heaviest_dropped=extremes[1],
    )


@njit(nogil=True)
def scene_in(sighted, zone, bounds):  # type: ignore[no-untyped-def]
    """The `ObservedStars`, `ZoneStars` and `ZonePairs` made from a sighting, a zone and bounds."""
    sigma_rad = sighted.sigma_rad
    reference_sigma = sigma_rad.min()
    weight = np.empty(len(sigma_rad))
    for k in range(len(sigma_rad)):
        ratio = reference_sigma / sigma_rad[k]
        weight[k] = ratio * ratio
    observed = ObservedStars(
        direction=sighted.direction,
        magnitude=sighted.magnitude,
        sigma_rad=sigma_rad,
        weight=weight,
        reference_sigma=reference_sigma,
        velocity=sighted.velocity,
        prior_kind=sighted.prior_kind,
        prior_axis=sighted.prior_axis,
    )
    stars = ZoneStars(
        direction=zone.direction,
        magnitude=zone.magnitude,
        grid_start=zone.grid_start,
        grid_rows=zone.grid_rows,
        grid_direction=zone.grid_direction,
        voxels=zone.voxels,
        axis=bounds.axis,
        least=bounds.least,
        most=bounds.most,
        polar=np.full(len(zone.direction), -1.0),
        log_density=log_density(zone.direction, bounds.axis, bounds.least, bounds.most),
    )
    pairs = ZonePairs(
        separation=zone.pair_separation,
        brighter=zone.pair_rows[0],
        dimmer=zone.pair_rows[1],
        bin_start=zone.bin_start,
        bins_per_rad=zone.bins_per_rad,
        polar_difference=zone.polar_difference,
        off_axis=bounds.off_axis,
    )
    return observed, stars, pairs


@njit_no_refcount
def with_magnitude(observed):  # type: ignore[no-untyped-def]
    """The number of observed stars with a magnitude."""
    count = 0
    for magnitude in observed.magnitude:
        if not math.isnan(magnitude):
            count += 1
    return count


@njit_inlined
def within_bounds(row, stars):  # type: ignore[no-untyped-def]
    """True if a zone star lies within the exact bounds on its angle to the axis."""
    if stars.polar[row] < 0.0:
        stars.polar[row] = separation_rad(stars.direction[row], stars.axis)
    return stars.least <= stars.polar[row] <= stars.most


@njit(nogil=True)
def log_density(direction, axis, least, most):  # type: ignore[no-untyped-def]
    """The logarithm of the number of stars per steradian between two angles from an axis."""
    inside = 0
    inner, outer = math.cos(least), math.cos(most)
    for row in range(len(direction)):
        r = direction[row]
        cosine = r[0] * axis[0] + r[1] * axis[1] + r[2] * axis[2]
        if outer <= cosine <= inner:
            inside += 1
    area = 2.0 * math.pi * (inner - outer)
    return math.log(max(inside, 1) / area)


@njit_no_refcount
def polar_difference(observed, i, j, tilt):  # type: ignore[no-untyped-def]
    """The difference of two stars' angles to the axis, and its error from noise and a tilted axis.

    A tilt changes the difference by at most the tilt times the chord between the stars' directions
    about the axis.
    """
    vi, vj = observed.direction[i], observed.direction[j]
    polar_i = separation_rad(vi, observed.prior_axis)
    polar_j = separation_rad(vj, observed.prior_axis)
    apart = separation_rad(vi, vj)
    sines = math.sin(polar_i) * math.sin(polar_j)
    chord2 = 4.0
    if sines > 0.0:
        # Half angles stay accurate where the angles are small.
        half = math.sin(0.5 * apart) ** 2 - math.sin(0.5 * (polar_i - polar_j)) ** 2
        chord2 = min(4.0, max(0.0, 4.0 * half / sines))
    noise = PREDICTION_GATE * math.sqrt(observed.sigma_rad[i] ** 2 + observed.sigma_rad[j] ** 2)
    return polar_i - polar_j, noise + tilt * math.sqrt(chord2)
