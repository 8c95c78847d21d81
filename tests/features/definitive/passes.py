"""Passes as they would be recorded: in the afternoon of a day of 1999."""

from dataclasses import replace

import numpy as np

from service.features.definitive.day import definitive_day
from service.features.definitive.kernels.inputs import (
    AttitudeMeasurements,
    DirectionMeasurements,
    no_directions,
)
from service.features.definitive.stretches import Recorded
from service.gyro.samples import GyroModel
from service.missions.motion import (
    GyroSettings,
    LiveFilterSettings,
    MotionSettings,
    SmoothingSettings,
)
from service.times import DAY_S, parse_utc
from tests.features.definitive.simulated import START_NS, attitudes_of, truth_of

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


def computed_day(recorded, mission):
    return definitive_day(recorded, mission, NOON.bucket(DAY_S))


def spun(rate_deg_per_s, rng, step_s=10.0, duration_s=900.0, carried=None, wander=0.0):
    """A body that spins at a rate (3,) and nutates by `wander` deg/s, seen every `step_s` seconds.

    `carried` (3,) in deg/s are the rates that its batches carry, by default its own.
    """
    spin = np.radians(rate_deg_per_s)
    across = np.cross(spin, [0.3, 0.5, 0.8])
    across *= np.radians(wander) / (np.linalg.norm(across) or 1.0)
    other = np.cross(spin, across) / (np.linalg.norm(spin) or 1.0)

    def rate(t):
        phase = 0.3 * np.linalg.norm(spin) * t[:, None]
        return spin + across * np.cos(phase) + other * np.sin(phase)

    truth = truth_of(rate, duration_s, 0.5)
    rows = np.arange(0, len(truth.time_s), round(step_s / 0.5))
    attitudes = attitudes_of(truth, rows, (6.0, 6.0, 40.0), rng)
    own = rate(truth.time_s[rows])
    rates = own if carried is None else np.tile(np.radians(carried), (len(rows), 1))
    recorded = replace(recorded_of([], np.zeros((0, 3)), attitudes), carried_rad_s=rates)
    return truth, rows, recorded, np.degrees(own)
