"""Random batches of every kind, as JSON objects, drawn from a run catalog.

Nothing of the service is used: what is drawn here is held against the service
and against the plain implementation alike.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.reference.plain_starid import PlainCatalog

Json = dict[str, Any]
Array = npt.NDArray[np.float64]

TIMES = ("1995-09-30T06:00:00.000Z", "1996-01-10T12:00:00.000Z", "1996-010T23:59:59.25Z")

# The paper's own places: centres of caps, poles of bands (right ascension, declination).
CAP_PLACES = {"desert": (12.25, -27.4), "forest": (265.6, -28.917)}
BAND_PLACES = {"desert": (292.3894, 80.0740), "forest": (191.1942, 27.6408)}


def direction(ra_deg: float, dec_deg: float) -> Array:
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


def rotation(axis: npt.ArrayLike, angle_deg: float) -> Array:
    """The matrix that turns vectors about an axis."""
    n = np.asarray(axis, float)
    n = n / np.linalg.norm(n)
    skew = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    angle = math.radians(angle_deg)
    return np.asarray(np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew)


def random_quaternion(rng: np.random.Generator) -> Array:
    q = rng.normal(size=4)
    return np.asarray(q / np.linalg.norm(q))


def quaternion_matrix(q: Array) -> Array:
    """A(q) written out element by element."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
            [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
            [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_quaternion(a: Array) -> Array:
    """The quaternion of A, from the eigenvector of Bar-Itzhack's matrix that belongs to one."""
    k = np.array(
        [
            [a[0, 0] - a[1, 1] - a[2, 2], a[1, 0] + a[0, 1], a[2, 0] + a[0, 2], a[1, 2] - a[2, 1]],
            [a[1, 0] + a[0, 1], a[1, 1] - a[0, 0] - a[2, 2], a[2, 1] + a[1, 2], a[2, 0] - a[0, 2]],
            [a[2, 0] + a[0, 2], a[2, 1] + a[1, 2], a[2, 2] - a[0, 0] - a[1, 1], a[0, 1] - a[1, 0]],
            [a[1, 2] - a[2, 1], a[2, 0] - a[0, 2], a[0, 1] - a[1, 0], np.trace(a)],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    return np.asarray(-q if q[3] < 0 else q)


def carrying(body: npt.ArrayLike, inertial: npt.ArrayLike, rng: np.random.Generator) -> Array:
    """An attitude matrix that takes one inertial direction to a body direction, roll random."""

    def frame(given: npt.ArrayLike) -> Array:
        axis = np.asarray(given, float)
        axis = axis / np.linalg.norm(axis)
        aside = rng.normal(size=3)
        aside -= (aside @ axis) * axis
        aside /= np.linalg.norm(aside)
        return np.column_stack([axis, aside, np.cross(axis, aside)])

    return np.asarray(frame(body) @ frame(inertial).T)


def prior_attitudes(rng: np.random.Generator, mission: Json, count: int) -> list[Array]:
    """A priori attitudes for a mission: random ones, and the paper's dense and empty places."""
    band = mission["zone"]["kind"] == "band"
    places = BAND_PLACES if band else CAP_PLACES
    attitudes = [
        carrying(mission["zone"]["axis_body"], direction(*place), rng) for place in places.values()
    ]
    while len(attitudes) < count:
        attitudes.append(quaternion_matrix(random_quaternion(rng)))
    return attitudes[:count]


def with_trackers(mission: Json, count: int) -> Json:
    """The mission with more trackers: in a cap tilted away, in a band turned about the pole."""
    first = mission["trackers"][0]
    trackers = []
    for k in range(count):
        turn = np.eye(3)
        if k and mission["zone"]["kind"] == "band":
            turn = rotation(mission["zone"]["axis_body"], 115.0 * k)
        elif k:
            turn = rotation([0.0, 0.2, 1.0], 60.0 * k)
        axes = {
            f"{axis}_axis_body": (turn @ np.array(first[f"{axis}_axis_body"], float)).tolist()
            for axis in "xyz"
        }
        trackers.append({**first, **axes, "name": f"STARTRACKER_{k + 1}"})
    return {**mission, "name": f"{mission['name']}-{count}", "trackers": trackers}


def draw_batch(
    rng: np.random.Generator,
    mission: Json,
    catalog: PlainCatalog,
    attitude: Array,
    number: int = 0,
    **fixed: Any,
) -> Json:
    """One batch about an a priori attitude, everything about it random.

    `fixed` may give `prior` ("quaternion", "boresight", "sun_pointed",
    "sun_vector", "sun_position"), `error_deg`, `stars`, `noise_arcsec`,
    `magnitude_noise`, `missing`, `spurious`, `options` and `time`.
    """
    band = mission["zone"]["kind"] == "band"

    def choice(name: str, *values: Any) -> Any:
        return fixed[name] if name in fixed else values[rng.integers(len(values))]

    kinds = ("sun_vector",) if band else ("boresight",) if len(mission["trackers"]) == 1 else ()
    kind = choice("prior", "quaternion", "quaternion", "quaternion", *kinds)
    time = choice("time", *TIMES)
    truth = _erroneous(rng, mission, attitude, choice("error_deg", 0.1, 0.1, 1.0, 3.0, 30.0))
    rates = rng.normal(size=3) * choice("rates_deg_per_s", 0.0, 0.0, 0.06, 0.5)
    noise = math.radians(choice("noise_arcsec", 2.1, 2.1, 12.0, 30.0) / 3600.0)
    batch: Json = {
        "spacecraft": mission["name"],
        "batch": f"{number:05d}",
        "time": time,
        "a_priori": prior_of(kind, mission, attitude),
        "body_rates_deg_per_s": rates.tolist(),
        "velocity_km_per_s": [0.0, 7.5, 0.0],
        "aberration": choice("aberration", "to_correct", "ignore", "applied_upstream"),
        "observations": [],
        "options": {**choice("options", *_options(rng, mission)), "identifier": "starid"},
    }
    for tracker in mission["trackers"]:
        alignment = np.column_stack([tracker[f"{axis}_axis_body"] for axis in "xyz"])
        radius = math.cos(math.radians(tracker["field_of_view_radius_deg"]))
        in_field = np.nonzero(catalog.directions @ (truth.T @ alignment[:, 2]) >= radius)[0]
        count = min(choice("stars", 1, 2, 3, 5, 5, 5, 8), len(in_field))
        chosen = rng.choice(in_field, count, replace=False)
        stars: list[Json] = []
        for row in chosen:
            offset = float(rng.uniform(-0.5, 0.5)) if rates.any() else 0.0
            body = truth @ catalog.directions[row]
            if rates.any():
                body = rotation(rates, -float(np.linalg.norm(rates)) * offset) @ body
            stars.append(
                _star(
                    rng,
                    alignment.T @ body + noise * rng.normal(size=3),
                    float(
                        catalog.magnitude[row]
                        + rng.normal() * choice("magnitude_noise", 0.1, 0.1, 0.5)
                    ),
                    offset,
                )
            )
        for _ in range(choice("spurious", 0, 0, 0, 1, 2) or (not stars)):
            around = rng.normal(size=2) * math.radians(tracker["field_of_view_radius_deg"]) / 2
            stars.append(_star(rng, np.array([*around, 1.0]), float(rng.uniform(2, 8)), 0.0))
        if rng.random() < choice("missing", 0.2):
            for star in stars:
                if rng.random() < 0.5:
                    del star["magnitude"]
        rng.shuffle(stars)
        batch["observations"].append({"tracker": tracker["name"], "stars": stars})
    return batch


def _erroneous(rng: np.random.Generator, mission: Json, attitude: Array, error_deg: float) -> Array:
    """A true attitude near the a priori one; in a band any roll about the pole as well."""
    error = rotation(rng.normal(size=3), rng.uniform(0.0, error_deg))
    if mission["zone"]["kind"] == "band":
        error = error @ rotation(mission["zone"]["axis_body"], rng.uniform(0.0, 360.0))
    return np.asarray(error @ attitude)


def prior_of(kind: str, mission: Json, attitude: Array) -> Json:
    """What a batch says that it knows, of the kind asked for."""
    axis = np.array(mission["zone"]["axis_body"], float) @ attitude
    if kind == "quaternion":
        return {"quaternion": matrix_quaternion(attitude).tolist(), "frame": "EME2000"}
    if kind == "boresight":
        ra, dec = math.degrees(math.atan2(axis[1], axis[0])), math.degrees(math.asin(axis[2]))
        return {"boresight": {"ra_deg": ra, "dec_deg": dec}}
    if kind == "sun_vector":
        return {"sun_pointed": True, "sun_vector": axis.tolist()}
    if kind == "sun_position":
        return {"sun_pointed": True, "position_km": [-1.2e6, 7.5e5, 3.1e5]}
    return {"sun_pointed": True}


def _star(rng: np.random.Generator, vector: Array, magnitude: float, offset: float) -> Json:
    vector = vector / np.linalg.norm(vector)
    star = {"magnitude": round(magnitude, 2)}
    if rng.random() < 0.5:
        star["vector"] = vector.tolist()
    else:
        star["h_deg"] = math.degrees(math.atan(vector[0] / vector[2]))
        star["v_deg"] = math.degrees(math.atan(vector[1] / vector[2]))
    if offset:
        star["time_offset_s"] = offset
    return star


def _options(rng: np.random.Generator, mission: Json) -> tuple[Json, ...]:
    """Nothing changed, switches in every combination, tolerances near the mission's and far."""
    band = mission["zone"]["kind"] == "band"
    names = ("magnitude", "cross_product", "pole") if band else ("magnitude", "cross_product")
    tests = {name: bool(rng.integers(2)) for name in names}
    # Left out by the prototype, and off unless a batch asks.
    tests |= {name: bool(rng.random() < 0.4) for name in ("fov_rotation", "match_groups")}
    ranges = {
        "separation_deg": (0.001, 0.02),
        "magnitude_mag": (0.1, 1.5),
        "magnitude_order_mag": (0.0, 1.5),
        "cross_product_deg": (5.0, 180.0),
        "fov_rotation_deg": (0.5, 180.0),
        "pole_difference_deg": (0.02, 0.5),
        "pole_angle_deg": (0.1, 10.0),
    }
    if not band:
        ranges = {name: ranges[name] for name in list(ranges)[:5]}
    tolerances = {
        name: float(rng.uniform(*limits)) for name, limits in ranges.items() if rng.random() < 0.4
    }
    if rng.random() < 0.2:
        tolerances["pair_separation_max_deg"] = mission["tolerances"]["pair_separation_max_deg"] / 2
    grid = {} if rng.random() < 0.4 else {"zone_grid_deg": float(rng.choice([0.0, 0.25, 1.0, 3.0]))}
    return (
        {**grid},
        {**grid},
        {"tests": tests, **grid},
        {"tolerances": tolerances, **grid},
        {"tests": tests, "tolerances": tolerances, **grid},
    )
