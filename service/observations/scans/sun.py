"""The direction of the Sun in the body from the counts of a sun tracker (star images, 5.3)."""

import math

import numpy as np

from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Mission
from service.observations.scans.profile import BREAKDOWN_RATIO
from service.vectors import Vector, unit


def sun_body(counts: Vector, mission: Mission, field: str) -> Vector:
    """The unit vector (3,) to the Sun in body axes.

    `counts` are I+ and I- of the pair along the tracker's X, then of that along Y.  Raises
    `BadBatch` naming `field` for a mission without a sun tracker, for pairs without light, and
    for signals beyond their straight part.
    """
    tracker = mission.sun_tracker
    if tracker is None:
        raise BadBatch(Fault(field, f"the mission file of {mission.name} has no sun_tracker"))
    limit = tracker.slope_per_arcmin * tracker.straight_to_arcmin
    plane = []
    for axis, (plus, minus) in zip(
        "XY", (counts - tracker.background_counts).reshape(2, 2), strict=True
    ):
        light = float(plus + minus)
        if light < BREAKDOWN_RATIO * math.sqrt(2.0) * tracker.noise_counts:
            message = f"the pair along {axis} has no sunlight: its light is below the noise"
            raise BadBatch(Fault(field, message, shown_value(light)))
        signal = float(plus - minus) / light
        if abs(signal) > limit:
            message = (
                f"the signal along {axis} is beyond {limit:.3g}: the Sun is farther off than "
                f"{tracker.straight_to_arcmin:g} arcmin, where the signal is not straight"
            )
            raise BadBatch(Fault(field, message, shown_value(signal)))
        plane.append(math.tan(math.radians(signal / tracker.slope_per_arcmin / 60.0)))
    return unit(tracker.body_from_tracker @ np.array([*plane, 1.0]))
