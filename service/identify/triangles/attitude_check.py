"""The attitude check: validation of proposed star identities by one common rotation.

Triangles have the same sides in a mirror, and enough random points match some catalog stars. So
proposed identities are checked in three steps: which of them agree with one another in every
separation; which proper rotation maps them; and how many of all observed stars then lie on a
catalog star. The required number makes a chance match unlikely.
"""

import math

import numpy as np

from service.compiled.arrays import copy_rows
from service.compiled.jit import njit
from service.identify.hypotheses.fitting import fit_match
from service.identify.hypotheses.local_search import LARGEST_GATE_RAD
from service.identify.hypotheses.scene import scratch_for
from service.sky.geometry.directions import axes_across, separation_rad
from service.sky.geometry.star_hashes import nearest

CHORD_SIGMAS = 4.0
"""Sigmas within which the separations of two proposals must agree."""
GATE_SIGMAS = 5.0
"""Sigmas within which an observed star matches a catalog star."""
FIRST_GATE = 2.0
"""Factor on the gate of the first fit, which rests on few stars."""
ALLOWED_CHANCE = 1e-4
"""Largest expected number of chance matches as good, over the whole sky; see `log_chance`."""
LEAST_SHARE = 0.3
"""Least share of the observed stars that must be matched."""
LEAST_WIDTH_SIGMAS = 8.0
"""Least scatter of stars about a line, in sigmas, that excludes a mirrored sky."""
LEAST_ODDS = 1e3
"""Least ratio of chance expectations between the second best and the best attitude."""
CERTAIN_CHANCE = 1e-12
"""Chance expectation below which no other attitude is looked for."""
MAX_PROPOSALS, MAX_SEEDS = 1000, 256
FIT_STEPS = 2


@njit(nogil=True)
def log_chance(observed, density, stars, separation, sigma_rad):  # type: ignore[no-untyped-def]
    """The logarithm of the expected number of attitudes with as many chance matches.

    The matched points are a subset of `observed`, one per entry of `density` (stars per steradian
    at its place). One of them may be on any of the catalog's `stars`, a second, at `separation`, on
    any star in the ring about it, and each further one on a star at its predicted place. The first
    two are those in the least crowded places. This is an upper bound, since the search does not
    examine every such match.
    """
    gate = GATE_SIGMAS * sigma_rad
    matched = len(density)
    ring = 2.0 * math.pi * math.sin(separation) * 2.0 * gate
    first = second = math.inf
    places = 0.0
    for k in range(matched):
        places += math.log(density[k] * math.pi * gate * gate)
        if density[k] < first:
            first, second = density[k], first
        elif density[k] < second:
            second = density[k]
    return (
        math.lgamma(observed + 1.0)
        - math.lgamma(matched + 1.0)
        - math.lgamma(observed - matched + 1.0)
        + math.log(stars)
        + math.log(ring * second)
        + places
        - math.log(first * math.pi * gate * gate)
        - math.log(second * math.pi * gate * gate)
    )


@njit(nogil=True, error_model="numpy")
def check_attitude(  # type: ignore[no-untyped-def]
    observed, stars, density, pair_image, pair_star, match, rival, t
):
    """Find the attitude that explains proposed identities; true if one is believed.

    `density` has the stars per steradian about each catalog star. Proposals are sorted most likely
    first. Results are `match` (n,), the catalog row of each observed star, -1 for none, `rival`, a
    second row within the gate, and `t` (3, 3), the rotation from catalog axes to those of the
    observed vectors. If two different attitudes are about as good, none is believed.
    """
    n, count = len(match), min(len(pair_image), MAX_PROPOSALS)
    match[:] = -1
    rival[:] = -1
    trial, second = np.empty(n, np.int32), np.empty(n, np.int32)
    scratch = scratch_for(n)
    grouped = np.zeros(count, np.bool_)
    members = np.empty(n, np.int64)
    widest = _widest(observed.direction)
    v = observed.velocity
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    least = runner_up = math.inf
    for seed in range(min(count, MAX_SEEDS)):
        if grouped[seed]:
            continue
        size = _group(observed, stars, speed, pair_image[:count], pair_star[:count], seed, members)
        if size < 3:
            continue
        trial[:] = -1
        for at in range(size):
            grouped[members[at]] = True
            trial[pair_image[members[at]]] = pair_star[members[at]]
        chance = _grow(observed, stars, density, widest, trial, second, scratch)
        differs = least < math.inf and not _is_same(match, trial)
        if chance < least:
            runner_up = least if differs else runner_up
            least = chance
            copy_rows(trial, match)
            copy_rows(second, rival)
            copy_rows(scratch.t, t)
        elif differs:
            runner_up = min(runner_up, chance)
        if least < math.log(CERTAIN_CHANCE):
            break
    return least < math.inf and runner_up - least > math.log(LEAST_ODDS)


@njit(nogil=True)
def _is_same(match, other):  # type: ignore[no-untyped-def]
    """True if two attitudes share at least half of the stars that either identifies."""
    same = named = 0
    for k in range(len(match)):
        if match[k] >= 0 or other[k] >= 0:
            named += 1
            if match[k] == other[k]:
                same += 1
    return 2 * same >= named


@njit(nogil=True)
def _group(observed, stars, speed, pair_image, pair_star, seed, members):  # type: ignore[no-untyped-def]
    """Collect a seed and the proposals that agree with it and each other; returns their number."""
    members[0] = seed
    size = 1
    for other in range(len(pair_image)):
        if other == seed or size == len(members):
            continue
        agrees = True
        for at in range(size):
            one = members[at]
            if not _agree(
                observed,
                stars,
                speed,
                pair_image[one],
                pair_image[other],
                pair_star[one],
                pair_star[other],
            ):
                agrees = False
                break
        if agrees:
            members[size] = other
            size += 1
    return size


@njit(nogil=True)
def _agree(observed, stars, speed, i, j, a, b):  # type: ignore[no-untyped-def]
    """True if observed stars i and j have the separation of catalog stars a and b, within noise."""
    if i == j or a == b:
        return False
    apart2 = should2 = 0.0
    for k in range(3):
        apart2 += (observed.direction[i, k] - observed.direction[j, k]) ** 2
        should2 += (stars.direction[a, k] - stars.direction[b, k]) ** 2
    apart = math.sqrt(apart2)
    sigma = math.sqrt(observed.sigma_rad[i] ** 2 + observed.sigma_rad[j] ** 2)
    tolerance = CHORD_SIGMAS * sigma + apart * speed
    return max(apart - tolerance, 0.0) ** 2 <= should2 <= (apart + tolerance) ** 2


@njit(nogil=True, error_model="numpy")
def _grow(observed, stars, density, widest, match, rival, scratch):  # type: ignore[no-untyped-def]
    """Fit an attitude, match all stars, fit again; log of the expected chance matches, or inf."""
    n = len(match)
    chance = math.inf
    for gate in (FIRST_GATE * GATE_SIGMAS, GATE_SIGMAS):
        count, _, _ = fit_match(observed, stars, match, scratch, FIT_STEPS)
        if count < 3:
            return math.inf
        _lay(observed, stars, scratch.t, gate, match, rival)
        matched, square = 0, 0.0
        for k in range(n):
            if match[k] >= 0:
                matched += 1
                square += observed.sigma_rad[k] ** 2
        if matched < 3:
            return math.inf
        sigma = math.sqrt(square / matched)
        places = density[match[match >= 0]]
        chance = log_chance(n, places, len(stars.direction), widest, sigma)
        if chance > math.log(ALLOWED_CHANCE) or matched < LEAST_SHARE * n:
            return math.inf
    count, _, _ = fit_match(observed, stars, match, scratch, FIT_STEPS)
    if count < 3 or not _is_right_handed(observed, match, scratch.t, scratch.references):
        return math.inf
    return chance


@njit(nogil=True)
def _widest(direction):  # type: ignore[no-untyped-def]
    """Largest separation in radians of two stars in a field, at most a right angle."""
    widest = 0.0
    for i in range(len(direction)):
        for j in range(i):
            widest = max(widest, separation_rad(direction[i], direction[j]))
    return min(widest, 0.5 * math.pi)


@njit(nogil=True)
def _lay(observed, stars, t, gate, match, rival):  # type: ignore[no-untyped-def]
    """Match each observed star to a catalog star at an attitude, and find a second match; else -1.

    A catalog star near two observed ones matches neither.
    """
    n = len(match)
    p, none = np.empty(3), np.empty(0, np.int32)
    for k in range(n):
        norm = 0.0
        for j in range(3):
            # Back in catalog axes, with aberration removed.
            p[j] = -observed.velocity[j]
            for i in range(3):
                p[j] += t[i, j] * observed.direction[k, i]
            norm += p[j] * p[j]
        norm = math.sqrt(norm)
        reach = min(gate * observed.sigma_rad[k], LARGEST_GATE_RAD)
        match[k], rival[k] = nearest(
            p[0] / norm,
            p[1] / norm,
            p[2] / norm,
            reach,
            stars.grid_start,
            stars.grid_rows,
            stars.grid_direction,
            none,
            0,
        )
    for k in range(n):
        for other in range(k):
            if match[k] >= 0 and match[other] == match[k]:
                rival[k] = rival[other] = match[k]
    for k in range(n):
        if match[k] >= 0 and rival[k] == match[k]:
            match[k] = -1


@njit(nogil=True)
def _is_right_handed(observed, match, t, references):  # type: ignore[no-untyped-def]
    """True if matched stars fit an attitude, and their shape excludes a mirror image.

    Their scatter about the best line through them must exceed the noise.
    """
    count = 0
    centre = np.zeros(3)
    largest = 0.0
    for k in range(len(match)):
        if match[k] < 0:
            continue
        off2 = 0.0
        for i in range(3):
            predicted = 0.0
            for j in range(3):
                predicted += t[i, j] * references[k, j]
            off2 += (observed.direction[k, i] - predicted) ** 2
            centre[i] += observed.direction[k, i]
        if off2 > (GATE_SIGMAS * observed.sigma_rad[k]) ** 2:
            return False
        largest = max(largest, observed.sigma_rad[k])
        count += 1
    norm = math.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    centre /= norm
    u, v = np.empty(3), np.empty(3)
    axes_across(centre, u, v)
    sx = sy = sxx = sxy = syy = 0.0
    for k in range(len(match)):
        if match[k] >= 0:
            b = observed.direction[k]
            x = b[0] * u[0] + b[1] * u[1] + b[2] * u[2]
            y = b[0] * v[0] + b[1] * v[1] + b[2] * v[2]
            sx, sy = sx + x, sy + y
            sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
    sxx, sxy, syy = sxx - sx * sx / count, sxy - sx * sy / count, syy - sy * sy / count
    narrow = 0.5 * (sxx + syy - math.sqrt((sxx - syy) ** 2 + 4.0 * sxy * sxy))
    return narrow > (LEAST_WIDTH_SIGMAS * largest) ** 2
