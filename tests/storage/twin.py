"""A spacecraft with two trackers, and batches of it."""

import json
import math

import numpy as np

from service.missions.mission import Mission
from service.observations.schema import submission_from_json
from service.times import shifted
from service.vectors import ARCSEC_PER_RADIAN
from tests.storage.samples import ATTITUDE, QUATERNION, START

FIRST, SECOND = "STARTRACKER_1", "STARTRACKER_2"


def twin(missions):
    """XTE with a second tracker, which looks along body Y; the whole sky takes tests too long."""
    settings = missions["XTE"].model_dump(mode="json")
    first = settings["trackers"][0] | {"name": FIRST}
    second = first | {
        "name": SECOND,
        "x_axis_body": [0.0, 0.0, 1.0],
        "y_axis_body": [1.0, 0.0, 0.0],
        "z_axis_body": [0.0, 1.0, 0.0],
    }
    settings |= {"trackers": [first, second], "lost_in_space_fallback": False}
    return Mission.model_validate(settings)


def lone(missions):
    """The same before it had the second tracker."""
    settings = missions["XTE"].model_dump(mode="json")
    return Mission.model_validate(
        {**settings, "trackers": [settings["trackers"][0] | {"name": FIRST}]}
    )


def batch(
    sky, mission, name="b1", *, noise_arcsec=(0.0, 0.0), offset_mag=0.0, run="live", after_s=0.0
):
    """Five stars of each tracker; the noise is each tracker's own, the offset the second's."""
    time = shifted(START, after_s)
    rng = np.random.default_rng(int(after_s) + 7)
    catalog = sky.run_catalog(mission, time)
    observations = []
    for tracker, noise, offset in zip(
        mission.trackers, noise_arcsec, (0.0, offset_mag), strict=False
    ):
        seen = catalog.direction @ ATTITUDE.T @ tracker.body_from_tracker
        least = math.cos(math.radians(tracker.field_of_view_radius_deg))
        rows = np.flatnonzero(seen[:, 2] > least)[:5]
        moved = seen[rows] + rng.normal(0.0, noise / ARCSEC_PER_RADIAN, (len(rows), 3))
        moved /= np.linalg.norm(moved, axis=1)[:, None]
        stars = [
            {"vector": vector.tolist(), "magnitude": float(magnitude) + offset}
            for vector, magnitude in zip(moved, catalog.magnitude_mag[rows], strict=True)
        ]
        observations.append({"tracker": tracker.name, "stars": stars})
    return json.dumps(
        {
            "spacecraft": "XTE",
            "run": run,
            "batch": name,
            "time": time.text,
            "a_priori": {"quaternion": QUATERNION, "frame": "EME2000"},
            "aberration": "ignore",
            "observations": observations,
        }
    )


def submission(sky, mission, name="b1", **wanted):
    """The same, read."""
    return submission_from_json(batch(sky, mission, name, **wanted))
