"""The attitude check: pairs of observed and catalog stars must be one rotated sky.

Sides of triangles are the same in a mirror, and enough random points will agree
with something.  So the proposals of an identifier are checked by three questions:
which proposals agree with one another in every separation; which rotation, a
proper one, carries them over; and how many of all observed stars then lie on a
catalog star.  So many are asked for that chance does not bring them together.
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
"""Two proposals agree where their separations do within so many standard deviations."""
GATE_SIGMAS = 5.0
"""A star lies on a catalog star within so many standard deviations."""
FIRST_GATE = 2.0
"""The first fit rests on few stars, and its gate is wider by this."""
ALLOWED_CHANCE = 1e-4
"""How often chance may be expected to do as well, anywhere in the sky; see `log_chance`."""
LEAST_SHARE = 0.3
"""Least share of the observed stars that must be matched."""
LEAST_WIDTH_SIGMAS = 8.0
"""Least scatter of stars about a line, in sigmas: in a row they do not exclude a mirrored sky."""
LEAST_ODDS = 1e3
"""The best attitude must be so many times less likely by chance than the best other one."""
CERTAIN_CHANCE = 1e-12
"""So unlikely by chance that no other attitude is looked for."""
MAX_PROPOSALS, MAX_SEEDS = 1000, 256
FIT_STEPS = 2


@njit(nogil=True)
def log_chance(observed, density, stars, separation, sigma_rad):  # type: ignore[no-untyped-def]
    """The logarithm of how many attitudes put so many random points on catalog stars.

    Of `observed` points those of `density` lie on one of the catalog's `stars`
    each: they are chosen, one of them put on any star, a second, at `separation`,
    on any star in the ring about it, and each further one is expected at one
    place, where there are `density` stars per steradian.  The two are those in
    the least crowded places.  An upper bound: not every such match is looked for.
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
    """Find the attitude that explains the proposals; whether there is one to believe.

    `density` are the stars per steradian about each catalog star.  Proposals come
    with the likeliest first.  Into `match` (n,) goes the catalog
    row on which each observed star lies, -1 for none, into `rival` a second one
    within the gate, into `t` (3, 3) the rotation from catalog axes to those of
    the observed vectors.  Where two different attitudes do about as well, none
    is believed.
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
    """True if two attitudes share at least half of the stars that either names."""
    same = named = 0
    for k in range(len(match)):
        if match[k] >= 0 or other[k] >= 0:
            named += 1
            if match[k] == other[k]:
                same += 1
    return 2 * same >= named


@njit(nogil=True)
def _group(observed, stars, speed, pair_image, pair_star, seed, members):  # type: ignore[no-untyped-def]
    """Proposals that agree with the seed and with each other, the likeliest taken first."""
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
    """True if observed stars i and j are as far apart as catalog stars a and b; by chords."""
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
    """Fit, lay all stars on the sky, fit again; ln of what chance could do, or infinity."""
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
    """The greatest separation in a field, at most a right angle: beyond it rings shrink again."""
    widest = 0.0
    for i in range(len(direction)):
        for j in range(i):
            widest = max(widest, separation_rad(direction[i], direction[j]))
    return min(widest, 0.5 * math.pi)


@njit(nogil=True)
def _lay(observed, stars, t, gate, match, rival):  # type: ignore[no-untyped-def]
    """Which catalog star each observed one lies on under an attitude, and which other as well.

    A catalog star that two observed ones lie on is neither's match.
    """
    n = len(match)
    p, none = np.empty(3), np.empty(0, np.int32)
    for k in range(n):
        norm = 0.0
        for j in range(3):
            # Back to catalog axes, and aberration taken off.
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
    """True if matched stars lie where the attitude predicts, and their shape excludes a mirror.

    Their scatter about the best line through them must be wider than the noise.
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
