"""STARID once more, plain and slow: what the service's answers are held against.

Written from the paper (Fink & Shoup 1994, sections 2.1 and 2.2) and from the
description of a batch alone; nothing of `service` is imported here.  No index,
no cache and no kernel: every pair of the exact zone is looked at, and every
test is one paragraph of Python in the order of the paper's steps.

    catalog = PlainCatalog(star_ids, ra_deg, dec_deg, magnitude)
    outcomes = identify(batch, mission, catalog)      # a list per tracker

`batch` is the JSON object, `mission` the parsed TOML file, and the catalog
holds the columns of `acquire catalog export`, rows in the same order.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations
from typing import Any

import erfa
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Json = dict[str, Any]
Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]
Triple = Sequence[float]
Node = tuple[int, int]

BODY_Z = np.array([0.0, 0.0, 1.0])
SUN_UNCERTAINTY_DEG = 0.3
"""What a Sun-pointed band is widened by when nobody says where the spacecraft is."""


@dataclass(frozen=True)
class PlainCatalog:
    star_ids: Sequence[str]
    ra_deg: Array
    dec_deg: Array
    magnitude: Array

    @cached_property
    def directions(self) -> Array:
        ra, dec = np.radians(self.ra_deg), np.radians(self.dec_deg)
        return np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


@dataclass(frozen=True)
class PlainOutcome:
    outcome: str
    star_id: str | None
    votes: int
    runner_up: int
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Settings:
    """The mission's numbers, the batch's own options in their place, in the paper's words."""

    HMAX: float
    SEPTOL: float
    XMTOL: float
    TMAGMX: float
    CROSSMAX: float  # CAPMAX or BANMAX
    BANTOL1: float
    BANTOL2: float
    rotation_deg: float
    magnitude_test: bool
    cross_product_test: bool
    pole_test: bool
    rotation_test: bool
    match_groups: bool


@dataclass(frozen=True)
class PlainZone:
    """The stars of a zone, and its pairs: brighter star first, rows of the catalog."""

    rows: Rows
    first: Rows
    second: Rows
    separation_deg: Array


def identify(
    batch: Json,
    mission: Json,
    catalog: PlainCatalog,
    zones: dict[Any, PlainZone] | None = None,
) -> list[list[PlainOutcome]]:
    """The outcome of every star of every tracker, in the order of the batch.

    `zones`, a dictionary, keeps the zones between calls for one catalog.
    """
    zones = {} if zones is None else zones
    settings = settings_of(batch, mission)
    attitude, widened_deg = prior_attitude(batch, mission)
    axis_body = np.array(mission["zone"]["axis_body"], dtype=float)
    pole = None
    if mission["zone"]["kind"] == "band":
        pole = attitude.T @ (axis_body / np.linalg.norm(axis_body))
    results = []
    for seen in batch["observations"]:
        tracker = next(t for t in mission["trackers"] if t["name"] == seen["tracker"])
        alignment = np.column_stack(
            [tracker["x_axis_body"], tracker["y_axis_body"], tracker["z_axis_body"]]
        )
        body = [body_vector(star, alignment, batch) for star in seen["stars"]]
        inertial = [attitude.T @ v for v in body]
        magnitude = [star.get("magnitude") for star in seen["stars"]]
        if pole is None:
            axis, low, high = attitude.T @ alignment[:, 2], 0.0, mission["zone"]["radius_deg"]
        else:
            middle = tracker.get("coelevation_deg", mission["zone"]["coelevation_deg"])
            half_width = mission["zone"]["half_width_deg"] + widened_deg
            axis, low, high = pole, middle - half_width, middle + half_width
        key = (tuple(axis), low, high, settings.HMAX)
        if key not in zones:
            zones[key] = zone_of(catalog, axis, low, high, settings.HMAX)
        boresight = attitude.T @ alignment[:, 2]
        results.append(vote(inertial, magnitude, zones[key], catalog, boresight, pole, settings))
    return results


# ---- from the batch to vectors ----------------------------------------------------------------


def settings_of(batch: Json, mission: Json) -> Settings:
    options = batch.get("options", {})
    tolerances = {**mission["tolerances"], **(options.get("tolerances") or {})}
    tests = {**mission.get("tests", {}), **(options.get("tests") or {})}
    is_band = mission["zone"]["kind"] == "band"
    roll_known = "boresight" not in batch["a_priori"]
    return Settings(
        HMAX=tolerances["pair_separation_max_deg"],
        SEPTOL=tolerances["separation_deg"],
        XMTOL=tolerances["magnitude_mag"],
        TMAGMX=tolerances["magnitude_order_mag"],
        CROSSMAX=tolerances["cross_product_deg"],
        BANTOL1=tolerances.get("pole_difference_deg", 0.13),
        BANTOL2=tolerances.get("pole_angle_deg", 7.2),
        rotation_deg=tolerances.get("fov_rotation_deg", 10.0),
        magnitude_test=tests.get("magnitude", True),
        cross_product_test=tests.get("cross_product", True) and roll_known,
        pole_test=tests.get("pole", True) and is_band,
        rotation_test=tests.get("fov_rotation", False) and roll_known,
        match_groups=tests.get("match_groups", False),
    )


def attitude_matrix(quaternion: Triple) -> Array:
    """A(q), inertial to body, of a quaternion with its scalar last (Shuster 1993, eq. 96)."""
    q = np.array(quaternion, dtype=float)
    q1, q2, q3, q4 = q / math.sqrt(sum(q * q))
    skew = np.array([[0, -q3, q2], [q3, 0, -q1], [-q2, q1, 0]])
    vector = np.array([q1, q2, q3])
    matrix = (q4 * q4 - vector @ vector) * np.eye(3) + 2 * np.outer(vector, vector) - 2 * q4 * skew
    return np.asarray(matrix)


def prior_attitude(batch: Json, mission: Json) -> tuple[Array, float]:
    """The a priori attitude matrix, and by how many degrees the zone is to be widened."""
    prior = batch["a_priori"]
    axis_body = np.array(mission["zone"]["axis_body"], dtype=float)
    if "quaternion" in prior:
        return attitude_matrix(prior["quaternion"]), 0.0
    if "boresight" in prior:
        ra = math.radians(prior["boresight"]["ra_deg"])
        dec = math.radians(prior["boresight"]["dec_deg"])
        towards = np.array(
            [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]
        )
        # Any roll will do: no test looks at it.
        aside = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        return attitude_with(axis_body, towards, BODY_Z, aside), 0.0
    sun = prior.get("sun_vector") or batch.get("sun_vector")
    position_km = prior.get("position_km") or batch.get("position_km")
    tt = terrestrial_time(batch["time"])
    widened_deg = 0.0
    if sun is None:
        earth_from_sun_km = erfa.epv00(*tt)[0]["p"] * erfa.DAU / 1000.0
        sun = -earth_from_sun_km - (np.zeros(3) if position_km is None else np.array(position_km))
        widened_deg = SUN_UNCERTAINTY_DEG if position_km is None else 0.0
    ecliptic_north = erfa.ecm06(*tt)[2]
    return attitude_with(axis_body, np.array(sun), BODY_Z, ecliptic_north), widened_deg


def attitude_with(
    axis_body: Array, axis_inertial: Array, side_body: Array, side_inertial: Array
) -> Array:
    """The attitude that carries one axis exactly, and a second as nearly as the first allows."""

    def frame(axis: Array, side: Array) -> Array:
        x = axis / np.linalg.norm(axis)
        z = side - (x @ side) * x
        if np.linalg.norm(z) < 1e-9:
            z = np.array([0.0, 1.0, 0.0]) - x[1] * x
        z = z / np.linalg.norm(z)
        return np.column_stack([x, np.cross(z, x), z])

    return np.asarray(frame(axis_body, side_body) @ frame(axis_inertial, side_inertial).T)


def terrestrial_time(text: str) -> tuple[float, float]:
    """Two-part Julian date in TT of UTC text, calendar or day-of-year."""
    day, clock = text.removesuffix("Z").split("T")
    hour, minute, second = clock.split(":")
    parts = [int(part) for part in day.split("-")]
    if len(parts) == 2:
        # ERFA takes 1 January plus a number of days as the two-part date.
        jd1, jd2 = erfa.dtf2d("UTC", parts[0], 1, 1, int(hour), int(minute), float(second))
        jd1 += parts[1] - 1
    else:
        jd1, jd2 = erfa.dtf2d("UTC", *parts, int(hour), int(minute), float(second))
    tt1, tt2 = erfa.taitt(*erfa.utctai(jd1, jd2))
    return float(tt1), float(tt2)


def body_vector(star: Json, alignment: Array, batch: Json) -> Array:
    """One observed star in body axes at the epoch of the batch."""
    if star.get("vector") is not None:
        v = np.array(star["vector"], dtype=float)
    else:
        v = np.array(
            [math.tan(math.radians(star["h_deg"])), math.tan(math.radians(star["v_deg"])), 1.0]
        )
    v = np.asarray(alignment @ (v / np.linalg.norm(v)))
    turn = np.radians(batch.get("body_rates_deg_per_s", [0.0, 0.0, 0.0]))
    turn = turn * star.get("time_offset_s", 0.0)
    angle = np.linalg.norm(turn)
    if angle == 0.0:
        return v
    # Rodrigues: the components parallel to, along and across the axis.
    n = turn / angle
    return np.asarray(
        v * math.cos(angle) + np.cross(n, v) * math.sin(angle) + n * (n @ v) * (1 - math.cos(angle))
    )


# ---- the zone and its pairs -------------------------------------------------------------------


def zone_of(
    catalog: PlainCatalog, axis: Array, low_deg: float, high_deg: float, HMAX: float
) -> PlainZone:
    """Every star whose angle to the axis lies within the limits, and every pair up to HMAX."""
    directions = catalog.directions
    from_axis = angles_deg(directions, np.broadcast_to(axis, directions.shape))
    rows = np.nonzero((from_axis >= low_deg) & (from_axis <= high_deg))[0]
    brightness = catalog.magnitude[rows]
    # One star against all that follow it: a rough cut by the cosine, then the exact angle.
    firsts, seconds, separations = [], [], []
    rough = math.cos(math.radians(min(HMAX + 0.01, 180.0)))
    chosen = directions[rows]
    for i in range(len(rows)):
        j = i + 1 + np.nonzero(chosen[i + 1 :] @ chosen[i] >= rough)[0]
        separation_deg = angles_deg(np.broadcast_to(chosen[i], (len(j), 3)), chosen[j])
        j, separation_deg = j[separation_deg <= HMAX], separation_deg[separation_deg <= HMAX]
        # i comes before j in the catalog and stays first among equals.
        swap = brightness[i] > brightness[j]
        firsts.append(np.where(swap, j, i))
        seconds.append(np.where(swap, i, j))
        separations.append(separation_deg)
    nothing = np.empty(0, int)
    first, second = np.concatenate([nothing, *firsts]), np.concatenate([nothing, *seconds])
    return PlainZone(rows, rows[first], rows[second], np.concatenate([np.empty(0), *separations]))


def angles_deg(a: Array, b: Array) -> Array:
    """Angles between rows of unit vectors, from the tangent: exact near 0, 90 and 180 degrees."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    cosine = np.sum(a * b, axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, cosine)))


def cross(a: Triple, b: Triple) -> Triple:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def angle_deg(a: Triple, b: Triple) -> float:
    """The same of two vectors of any length, as three plain numbers each."""
    sine = math.hypot(*cross(a, b))
    return math.degrees(math.atan2(sine, a[0] * b[0] + a[1] * b[1] + a[2] * b[2]))


# ---- steps 1 to 10 and the votes --------------------------------------------------------------


def vote(
    observed_vectors: list[Array],
    magnitude: list[float | None],
    zone: PlainZone,
    catalog: PlainCatalog,
    boresight: Array,
    pole_vector: Array | None,
    settings: Settings,
) -> list[PlainOutcome]:
    """The outcome of each observed star from the votes of every surviving pair of pairs."""
    observed: list[Triple] = [v.tolist() for v in observed_vectors]
    pole: Triple | None = None if pole_vector is None else pole_vector.tolist()
    said: list[tuple[Node, Node]] = []
    for one, two in combinations(range(len(observed)), 2):
        separation_deg = angle_deg(observed[one], observed[two])
        near = np.nonzero(np.abs(zone.separation_deg - separation_deg) <= settings.SEPTOL)[0]
        for pair in near:
            c1, c2 = int(zone.first[pair]), int(zone.second[pair])
            accepted, LORD = pair_survives(
                (observed[one], observed[two]),
                (magnitude[one], magnitude[two]),
                (catalog.directions[c1].tolist(), catalog.directions[c2].tolist()),
                (float(catalog.magnitude[c1]), float(catalog.magnitude[c2])),
                pole,
                settings,
            )
            if not accepted:
                continue
            ways = [(c1, c2)] if LORD == 1 else [(c2, c1)] if LORD == -1 else [(c1, c2), (c2, c1)]
            said += [
                ((one, a), (two, b))
                for a, b in ways
                if not settings.rotation_test
                or rotation_about_boresight_deg(
                    (observed_vectors[one], observed_vectors[two]),
                    (catalog.directions[a], catalog.directions[b]),
                    boresight,
                    pole_vector,
                )
                <= settings.rotation_deg
            ]
    tally: list[dict[int, int]] = [{} for _ in observed]
    if settings.match_groups:
        members, size = largest_groups(said)
        for star, row in members:
            tally[star][row] = size - 1
    else:
        for star, row in chain.from_iterable(said):
            tally[star][row] = tally[star].get(row, 0) + 1
    return [outcome_of(votes, catalog) for votes in tally]


def pair_survives(
    observed: tuple[Triple, Triple],
    magnitude: tuple[float | None, float | None],
    candidate: tuple[Triple, Triple],
    candidate_magnitude: tuple[float, float],
    pole: Triple | None,
    settings: Settings,
) -> tuple[bool, int]:
    """IFLAG and LORD of an observed and a candidate pair, the candidate's brighter star first."""
    # Steps 1 to 3: the magnitudes.
    m1, m2 = magnitude
    LMAGT, LORD = False, 0
    if settings.magnitude_test and m1 is not None and m2 is not None:
        LMAGT = abs(m1 - m2) >= settings.TMAGMX
    if LMAGT and m1 is not None and m2 is not None:
        brighter, dimmer = min(m1, m2), max(m1, m2)
        if abs(brighter - candidate_magnitude[0]) > settings.XMTOL:
            return False, 0
        if abs(dimmer - candidate_magnitude[1]) > settings.XMTOL:
            return False, 0
        LORD = 1 if m1 <= m2 else -1

    # Steps 6 to 9: the closeness to the pole of a band.
    if settings.pole_test and pole is not None:
        GTO1, GTO2 = (angle_deg(v, pole) for v in observed)
        GTR1, GTR2 = (angle_deg(v, pole) for v in candidate)
        GTODIF, GTRDIF = abs(GTO1 - GTO2), abs(GTR1 - GTR2)
        if abs(GTODIF - GTRDIF) > settings.BANTOL1:
            return False, 0
        if GTODIF > settings.BANTOL1 and GTRDIF > settings.BANTOL1:
            if abs(max(GTO1, GTO2) - max(GTR1, GTR2)) > settings.BANTOL2:
                return False, 0
            if abs(min(GTO1, GTO2) - min(GTR1, GTR2)) > settings.BANTOL2:
                return False, 0
            by_pole = 1 if (GTO1 > GTO2) == (GTR1 > GTR2) else -1
            if LMAGT and by_pole != LORD:
                return False, 0
            return True, by_pole

    # Steps 4 and 5, and step 10: the cross products.
    if settings.cross_product_test:
        CRSSEP = cross_product_angle_deg(observed, candidate)
        if CRSSEP is None:
            return False, 0
        CRSSEN = 180.0 - CRSSEP
        if LORD == 0:
            forward, reversed_ = CRSSEP <= settings.CROSSMAX, CRSSEN <= settings.CROSSMAX
            # Both only beyond 90 deg: the ambiguous geometry of section 2, which leaves LORD open.
            if forward and reversed_:
                return True, 0
            return forward or reversed_, 1 if forward else -1 if reversed_ else 0
        if (CRSSEP if LORD == 1 else CRSSEN) > settings.CROSSMAX:
            return False, 0
    return True, LORD


def cross_product_angle_deg(
    observed: tuple[Triple, Triple], candidate: tuple[Triple, Triple]
) -> float | None:
    """CRSSEP; None where a pair stands in one line and has no cross product to compare."""
    a, b = cross(*observed), cross(*candidate)
    return None if not any(a) or not any(b) else angle_deg(a, b)


# ---- the two tests that the prototype left out ------------------------------------------------


def rotation_about_boresight_deg(
    observed: tuple[Array, Array],
    candidate: tuple[Array, Array],
    boresight: Array,
    pole: Array | None,
) -> float:
    """How far the sky would have to turn about the boresight for one pair to fall on the other.

    The whole turn carries the middle of the observed pair, and the line from its
    first star to its second, to those of the candidate.  In a cap it is split
    into a rotation about the boresight and one that moves the boresight the
    short way.  In a band it may hold any rotation about the pole, so that only
    the pole tells: how it turns as seen along the boresight where that comes to.
    Infinite where a pair is one point and gives no turn.
    """

    def frame(pair: tuple[Array, Array]) -> Array:
        middle, line = pair[0] + pair[1], pair[1] - pair[0]
        middle, line = middle / np.linalg.norm(middle), line / np.linalg.norm(line)
        return np.column_stack([middle, line, np.cross(middle, line)])

    if not np.any(observed[0] - observed[1]) or not np.any(candidate[0] - candidate[1]):
        return math.inf
    turn = frame(candidate) @ frame(observed).T
    if pole is None:
        quaternion = Rotation.from_matrix(turn).as_quat()
        half = math.atan2(quaternion[:3] @ boresight, quaternion[3])
        return abs(math.degrees(math.remainder(2.0 * half, math.tau)))
    along = turn @ boresight
    expected, found = pole - (pole @ along) * along, turn @ pole
    return angle_deg(expected.tolist(), (found - (found @ along) * along).tolist())


def largest_groups(said: list[tuple[Node, Node]]) -> tuple[set[Node], int]:
    """The nodes of the largest groups of which every two are joined, and the size of these.

    A node is an observed star taken for a row of the catalog.
    """
    joined: dict[Node, set[Node]] = {}
    for one, two in said:
        joined.setdefault(one, set()).add(two)
        joined.setdefault(two, set()).add(one)
    best, members = 0, set[Node]()

    def grow(group: list[Node], open_nodes: set[Node]) -> None:
        nonlocal best, members
        if len(group) + len({star for star, _ in open_nodes}) < best:
            return
        if not open_nodes:
            if len(group) > best:
                best, members = len(group), set()
            members |= set(group)
        # A group is grown in the order of its stars.
        for node in open_nodes:
            grow([*group, node], {n for n in open_nodes & joined[node] if n[0] > node[0]})

    grow([], set(joined))
    return members, best


def outcome_of(votes: dict[int, int], catalog: PlainCatalog) -> PlainOutcome:
    """A single maximum is the star, a shared one is ambiguous, no vote at all is unmatched."""
    if not votes:
        return PlainOutcome("unmatched", None, 0, 0)
    ranked = sorted(votes.values(), reverse=True)
    most, runner_up = ranked[0], ranked[1] if len(ranked) > 1 else 0
    leaders = [row for row in sorted(votes) if votes[row] == most]
    if len(leaders) == 1:
        return PlainOutcome("unique", str(catalog.star_ids[leaders[0]]), most, runner_up)
    return PlainOutcome(
        "ambiguous", None, most, runner_up, tuple(str(catalog.star_ids[row]) for row in leaders)
    )
