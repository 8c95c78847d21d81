"""Batches with known outcomes, drawn from the run catalog itself."""

import json

import numpy as np

from service.observations.schema import submission_from_json
from service.times import parse_utc, shifted
from service.vectors import ARCSEC_PER_RADIAN, matrix_from_quaternion, unit

START = parse_utc("1996-01-10T12:00:00.000Z")
QUATERNION = [0.1, 0.2, 0.3, 0.9273618495495703]
ATTITUDE = matrix_from_quaternion(QUATERNION)

KINDS = ("good", "suspect", "one_star", "spurious")


def batch(
    sky, missions, name="b1", *, kind="good", spacecraft="XTE", run="live", after_s=0.0, stars=5
):
    """A batch as JSON text: `kind` says what is to come of it.

    good: every star is unique, the attitude good.  suspect: one star lies 18
    arcsec off, within the tolerance and far beyond the noise.  one_star: no
    attitude.  spurious: one of the stars is none.
    """
    mission, time = missions[spacecraft], shifted(START, after_s)
    tracker = mission.trackers[0]
    catalog = sky.run_catalog(mission, time)
    in_tracker = catalog.direction @ ATTITUDE.T @ tracker.body_from_tracker
    inside = np.flatnonzero(in_tracker[:, 2] > np.cos(np.radians(tracker.field_of_view_radius_deg)))
    seen = inside[: 1 if kind == "one_star" else stars]
    vectors, magnitudes = in_tracker[seen].copy(), catalog.magnitude_mag[seen].copy()
    if kind == "suspect":
        vectors[0] = unit(vectors[0] + [18.0 / ARCSEC_PER_RADIAN, 0.0, 0.0])
    if kind == "spurious":
        vectors[0] = unit(vectors[0] + [0.003, 0.001, 0.0])
        magnitudes[0] = 1.0
    return json.dumps(
        {
            "spacecraft": spacecraft,
            "run": run,
            "batch": name,
            "time": time.text,
            "a_priori": {"quaternion": QUATERNION, "frame": "EME2000"},
            "aberration": "ignore",
            "observations": [
                {
                    "tracker": tracker.name,
                    "stars": [
                        {"vector": vector.tolist(), "magnitude": float(magnitude)}
                        for vector, magnitude in zip(vectors, magnitudes, strict=True)
                    ],
                }
            ],
        }
    )


def submission(sky, missions, name="b1", **wanted):
    """The same, read."""
    return submission_from_json(batch(sky, missions, name, **wanted))


def without_accidents(answer):
    """An answer without what differs between equal runs: id, timings, whether a zone was cached."""
    kept = {key: value for key, value in answer.items() if key not in ("id", "timings_us")}
    for each in kept["observations"]:
        each["zone"].pop("cached")
    return kept
