"""Passes as they would be recorded: in the afternoon of a day of 1999."""

from dataclasses import replace

import numpy as np

from service.filtering.inputs import (
    AttitudeMeasurements,
    DirectionMeasurements,
    GyroModel,
    no_directions,
)
from service.grades.day import grade_day
from service.grades.stretches import Recorded
from service.missions.motion import (
    GyroSettings,
    LiveFilterSettings,
    MotionSettings,
    SmoothingSettings,
)
from service.times import DAY_S, parse_utc
from tests.filtering.simulated import START_NS

NOON = parse_utc("1999-03-01T12:00:00Z")
NOON_NS = NOON.tai_ns
MODEL = GyroModel(10**0.5 * 1e-7, 10**0.5 * 1e-10)
GYRO = {"sigma_v_rad_s0_5": 10**0.5 * 1e-7, "sigma_u_rad_s1_5": 10**0.5 * 1e-10}


def mission_with(mission, **tables):
    """A mission with other tables `gyro`, `motion`, `live_filter` or `smoothing`."""
    kinds = {
        "gyro": GyroSettings,
        "motion": MotionSettings,
        "live_filter": LiveFilterSettings,
        "smoothing": SmoothingSettings,
    }
    return mission.model_copy(update={name: kinds[name](**told) for name, told in tables.items()})


def later(recorded, ns):
    """The same, so much later."""
    a, d = recorded.attitudes, recorded.directions
    return replace(
        recorded,
        gyro_ns=recorded.gyro_ns + ns,
        attitudes=AttitudeMeasurements(a.tai_ns + ns, a.quaternion, a.covariance_rad2),
        directions=DirectionMeasurements(d.tai_ns + ns, d.body, d.inertial, d.sigma_rad),
    )


def recorded_of(gyro_ns, rates, attitudes):
    """A record of simulated measurements, which begins at noon."""
    recorded = Recorded(np.asarray(gyro_ns, dtype=np.int64), rates, attitudes, no_directions())
    return later(recorded, NOON_NS - START_NS)


def graded(recorded, mission):
    return grade_day(recorded, mission, NOON.bucket(DAY_S))
