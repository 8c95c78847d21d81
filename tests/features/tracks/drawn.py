"""Simulated stretches with an object, two planets and hot pixels among the stars of a tracker.

What is put in is worked out here from the attitude that the simulator drew, and from ERFA.
"""

from dataclasses import dataclass

import erfa
import numpy as np

from service.acquire import acquire
from service.features.tracks.linking import Gathering
from service.observations.schema import BatchIn, submission_from_model
from service.simulate.sightings import BatchScene, anywhere, real_sky, shaken
from service.simulate.stretches import Stretch
from service.sky.ephemeris import PLANETS, apparent, observer_velocity, planet_place
from service.times import parse_utc, shifted
from service.vectors import (
    ARCSEC_PER_RADIAN,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotate_about,
    unit,
)

BATCHES, CADENCE_S = 30, 10.0
STARS = 8
APART_DEG = 4.5
OBJECT_MAG, PLANET_MAG, HOT_MAG = 5.0, 2.0, 4.0
MAGNITUDE_SIGMA = 0.1
DETECTED = 0.9


@dataclass
class Stretched:
    """The batches as they are sent, with and without what is no star, and the truth."""

    with_points: list
    stars_only: list
    planets: tuple
    rate_arcsec_per_s: np.ndarray
    middle_s: float
    place: np.ndarray
    where: list
    """Of each batch: what each point of the tracker is, None a star."""


def conjunctions(rng, count):
    """Moments at which two planets are within a field of view, away from the Sun, and who.

    Of two years: each has a run catalog, and an index of the whole sky, of its own.
    """
    found = []
    first = parse_utc(f"{rng.choice((1994, 2000, 2012, 2020))}-07-01T00:00:00Z")
    while len(found) < count:
        time = shifted(first, int(rng.integers(0, 730 * 86400)))
        seen = np.array([planet_place(each, time, None).direction for each in PLANETS])
        sun = -unit(np.asarray(erfa.epv00(*time.tt)[0]["p"]))
        one, other = np.triu_indices(len(PLANETS), 1)
        apart = np.degrees(np.arccos(np.clip(np.sum(seen[one] * seen[other], axis=1), -1, 1)))
        away = np.degrees(np.arccos(np.clip(seen @ sun, -1, 1))) > 20.0
        near = np.flatnonzero((apart < APART_DEG) & away[one] & away[other])
        found += [(time, PLANETS[one[k]], PLANETS[other[k]]) for k in near]
    return found[:count]


def draw(mission, sky, moment, rng):
    """One stretch about a conjunction."""
    time, *planets = moment
    tracker = mission.trackers[0]
    position = np.array([7000.0, 0.0, 0.0])
    velocity = np.array([0.0, 7.5, 0.0])
    centre = unit(sum(planet_place(each, time, position).direction for each in planets))
    x = unit(np.cross(centre, unit(rng.normal(size=3))))
    in_tracker = np.stack([x, np.cross(centre, x), centre])
    attitude = tracker.body_from_tracker @ in_tracker
    rates = rng.normal(size=3) * 0.002
    speed = np.exp(rng.uniform(np.log(0.5), np.log(30.0)))
    middle_s = 0.5 * (BATCHES - 1) * CADENCE_S
    place = shaken(centre[None], np.radians(1.0), rng)[0]
    way = unit(np.cross(place, unit(rng.normal(size=3))))
    # The ephemeris that is known is off, each planet by some part of its error.
    errors = [
        planet_place(each, time, position).error_arcsec / ARCSEC_PER_RADIAN * rng.uniform(0, 0.7)
        for each in planets
    ]
    sides = [unit(np.cross(centre, unit(rng.normal(size=3)))) for _ in planets]
    hot = anywhere(np.radians(3.5), 3, rng)
    made = Stretched([], [], tuple(each.name for each in planets), speed * way, middle_s, place, [])
    for k in range(BATCHES):
        now = shifted(time, k * CADENCE_S)
        elapsed = (k * CADENCE_S - middle_s) * speed / ARCSEC_PER_RADIAN
        velocity_c = observer_velocity(now, velocity)
        scene = BatchScene(
            mission=mission,
            sky=real_sky(sky.catalog, mission.catalog, sky.run_catalog(mission, now)),
            time=now,
            position_km=position,
            velocity_c=velocity_c,
            aberration="to_correct",
            rates_deg_per_s=rates,
            stretch=Stretch("nominal", 0.0, 0.0),
            rng=rng,
        )
        here = rotate_about(-np.radians(rates) * k * CADENCE_S, attitude.T).T
        _, seen = scene.look(here, STARS)
        stars = scene.measured(seen[0], as_angles=False)
        sky_points = [np.cos(elapsed) * place + np.sin(elapsed) * way]
        for each, error, side in zip(planets, errors, sides, strict=True):
            sky_points.append(unit(planet_place(each, now, position).direction + error * side))
        seen_points = apparent(np.array(sky_points), velocity_c, now) @ here.T
        seen_points = seen_points @ tracker.body_from_tracker
        noise = tracker.sigma_arcsec / ARCSEC_PER_RADIAN
        points = shaken(np.concatenate([seen_points, hot]), noise, rng)
        names = ["object", *made.planets, "hot", "hot", "hot"]
        magnitudes = [OBJECT_MAG, PLANET_MAG, PLANET_MAG, HOT_MAG, HOT_MAG, HOT_MAG]
        keep = (points[:, 2] > tracker.least_cosine) & (rng.random(6) < DETECTED)
        added = [
            {
                "vector": points[n].tolist(),
                "magnitude": magnitudes[n] + MAGNITUDE_SIGMA * rng.normal(),
            }
            for n in np.flatnonzero(keep)
        ]
        error = matrix_from_quaternion(unit(np.append(rng.normal(size=3) * 0.005, 1.0)))
        batch = {
            "spacecraft": mission.name,
            "batch": f"b{k:04}",
            "time": now.text,
            "a_priori": {"quaternion": quaternion_from_matrix(error @ here).tolist()},
            "body_rates_deg_per_s": rates.tolist(),
            "velocity_km_per_s": velocity.tolist(),
            "position_km": position.tolist(),
        }
        order = rng.permutation(len(stars) + len(added))
        both = [(stars + added)[n] for n in order]
        what = [None] * len(stars) + [names[n] for n in np.flatnonzero(keep)]
        made.where.append([what[n] for n in order])
        made.with_points.append(
            batch | {"observations": [{"tracker": tracker.name, "stars": both}]}
        )
        made.stars_only.append(
            batch | {"observations": [{"tracker": tracker.name, "stars": stars}]}
        )
    return made


def acquired(batches, mission, sky):
    """What the service makes of batches."""
    return [
        acquire(submission_from_model(BatchIn.model_validate(each)).batch, mission, sky)
        for each in batches
    ]


def gathered(acquisitions, mission):
    """The unexplained points of the batches that have an attitude."""
    taken = Gathering(mission.trackers)
    for each in acquisitions:
        if each.solution is not None:
            taken.add(
                each.batch,
                [result.corrected for result in each.trackers],
                [np.flatnonzero(result.identification.outcome == 0) for result in each.trackers],
                matrix_from_quaternion(each.solution.quaternion),
                each.solution.covariance_arcsec2,
            )
    return taken
