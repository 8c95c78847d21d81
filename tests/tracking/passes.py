"""Passes whose batches ask for the last attitude, with gaps and flips, and their truth."""

from dataclasses import dataclass

import numpy as np

from service.missions.mission import Band
from service.missions.motion import MotionSettings, TrackingSettings
from service.simulate.motion import orbit_of, pointed, random_axis, turned_by
from service.simulate.sightings import BatchScene, real_sky
from service.simulate.stretches import Stretch
from service.sky.ephemeris import observer_velocity, sun_direction
from service.times import parse_utc, shifted
from service.vectors import attitude_error_arcsec, matrix_from_quaternion

START = parse_utc("1997-01-15T00:00:00.000Z")
"""SOHO's band crosses Carina then, where stars stand closest."""
WALK_RAD_S1_5 = 2e-6
STAY = 0.98
"""Of the rate, from one batch to the next: it stays bounded."""


def tracked(mission, **settings):
    """The mission with the motion of these passes, and other settings of its tracking."""
    motion = MotionSettings(rate_walk_rad_s1_5=2 * WALK_RAD_S1_5, rate_sigma_rad_s=2e-4)
    settings = TrackingSettings(**settings)
    return mission.model_copy(update={"motion": motion, "tracking": settings})


@dataclass(frozen=True)
class Flown:
    """A batch as it is sent, its true attitude, its stars, and the rate after it."""

    body: dict
    attitude: np.ndarray
    stars: list
    rate_rad_s: np.ndarray

    def wrong(self, answer):
        """What is wrong in an answer that is sure of itself."""
        faults = []
        attitude = answer["attitude"]
        if attitude is not None and attitude["status"] == "good":
            error = attitude_error_arcsec(
                matrix_from_quaternion(attitude["quaternion"]), self.attitude
            )
            weighted = error @ np.linalg.solve(np.array(attitude["covariance_arcsec2"]), error)
            if weighted > 36.0 and np.linalg.norm(error) > 60.0:
                faults.append(f"attitude off by {error} arcsec")
        for told, true in zip(answer["observations"], self.stars, strict=True):
            faults += [
                f"{star['star']['id']} for {name}"
                for star, name in zip(told["stars"], true, strict=True)
                if star["outcome"] == "unique" and star["star"]["id"] != name
            ]
        return faults


def fly(mission, sky, batches, seed, *, flips=(), gaps=None, most=5, cadence_s=30.0, dense=False):
    """Batches of a pass: before those of `flips` the body has rolled by half a turn.

    `gaps` are seconds of silence before batches by their numbers.
    """
    rng = np.random.default_rng(seed)
    orbit, time = orbit_of(mission), START
    rate = rng.normal(0.0, WALK_RAD_S1_5 * np.sqrt(cadence_s / (1 - STAY**2)), 3)
    run_sky = real_sky(sky.catalog, mission.catalog, sky.run_catalog(mission, START))
    attitude = _first(mission, run_sky.run.direction if dense else None, rng)
    for k in range(batches):
        passed_s = (gaps or {}).get(k, cadence_s) if k else 0.0
        time = shifted(time, passed_s)
        attitude = turned_by(attitude, rate * passed_s)
        if k in flips:
            attitude = turned_by(attitude, np.pi * mission.axis_body)
        position_km, velocity = (np.round(each, 4) for each in orbit.state(time))
        scene = BatchScene(
            mission=mission,
            sky=run_sky,
            time=time,
            position_km=position_km,
            velocity_c=observer_velocity(time, velocity),
            aberration="to_correct",
            rates_deg_per_s=np.zeros(3),
            stretch=Stretch(),
            rng=rng,
        )
        attitude, seen = scene.look(attitude, most)
        u, _, vt = np.linalg.svd(attitude)
        attitude = u @ vt
        body = {
            "spacecraft": mission.name,
            "batch": f"b{k:05d}",
            "time": time.text,
            "a_priori": {"from": "last"},
            "velocity_km_per_s": velocity.tolist(),
            "position_km": position_km.tolist(),
            "observations": [
                {
                    "tracker": each.tracker.name,
                    # All stars are at the batch's own time, for the rates are not told.
                    "stars": [
                        star | {"time_offset_s": 0.0} for star in scene.measured(each, False)
                    ],
                }
                for each in seen
            ],
        }
        ids = run_sky.run.star_id
        stars = [[None if row < 0 else ids[row] for row in each.star] for each in seen]
        yield Flown(body, attitude, stars, rate)
        rate = STAY * rate + rng.normal(0.0, WALK_RAD_S1_5 * np.sqrt(cadence_s), 3)


def _first(mission, stars, rng):
    """Anywhere, in a band with its pole on the Sun; if given, where it has most of `stars`."""
    if isinstance(mission.zone, Band):
        pole = sun_direction(START, None)
        if stars is None:
            return pointed(mission.axis_body, pole, rng.uniform(0.0, 2 * np.pi))
        rolls = np.arange(0.0, 2 * np.pi, np.radians(1.0))
        attitudes = [pointed(mission.axis_body, pole, roll) for roll in rolls]
        tracker = mission.trackers[0]
        seen = [
            (stars @ (tracker.boresight_body @ each) > tracker.least_cosine).sum()
            for each in attitudes
        ]
        return attitudes[int(np.argmax(seen))]
    return pointed(mission.axis_body, random_axis(rng), rng.uniform(0.0, 2 * np.pi))
