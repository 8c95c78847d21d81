"""Filtered attitudes from batches of one star are as good as they are given out to be."""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from service.attitude.definitive import Status
from service.features.definitive.kernels.inputs import DirectionMeasurements
from service.vectors import ARCSEC_PER_RADIAN
from tests.features.definitive.passes import (
    GYRO,
    MODEL,
    NOON_NS,
    computed_day,
    mission_with,
    recorded_of,
)
from tests.features.definitive.simulated import (
    ARCSEC,
    START_NS,
    attitudes_of,
    gyro_of,
    slews,
    squares,
    truth_of,
)
from tests.scale import size

PASSES, FEW_PASSES, ATTITUDES, LASTS_S, EVERY_S = 1000, 20, 10, 1200.0, 8
SIGMA_RAD = 6.0 * ARCSEC
LIMIT, SHARE_BEYOND = 9.0, 0.035
"""Of chi-square with three degrees of freedom 2.9 % lie beyond 9."""


def one_star_each(truth, rows, rng):
    """A direction a row, anywhere within four degrees of the boresight, body X."""
    aside = math.radians(4.0) * np.sqrt(rng.random(len(rows)))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(rows))
    seen = np.stack([np.ones(len(rows)), aside * np.cos(angle), aside * np.sin(angle)], axis=1)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    noise = Rotation.from_rotvec(rng.normal(0.0, SIGMA_RAD, (len(rows), 3)))
    return DirectionMeasurements(
        truth.tai_ns[rows] + NOON_NS - START_NS,
        noise.apply(seen),
        truth.attitude[rows].apply(seen),
        np.full(len(rows), SIGMA_RAD),
    )


def filtered(recorded, mission):
    """The filtered samples of a pass of one stretch."""
    (stretch,) = computed_day(recorded, mission).stretches
    return stretch.samples["filtered"]


def test_few_filtered_attitudes_from_one_star_are_off_by_more_than_three_sigmas(
    missions, seed, figures
):
    mission = mission_with(missions["XTE"], gyro=GYRO)
    rng = np.random.default_rng(seed)
    passes = size(PASSES, FEW_PASSES)
    truth = truth_of(slews, LASTS_S)
    rows = np.arange(0, int(LASTS_S) + 1, EVERY_S)
    first, alone = rows[:ATTITUDES], rows[ATTITUDES:]
    shares, good, across = [], [], []
    for number in range(passes):
        gyro, _ = gyro_of(truth, MODEL, rng)
        attitudes = attitudes_of(truth, first, (6.0, 6.0, 40.0), rng)
        recorded = recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes)
        stars = one_star_each(truth, alone, rng)
        samples = filtered(replace(recorded, directions=stars), mission)
        place = np.searchsorted(samples.tai_ns, stars.tai_ns)
        is_good = samples.status[place] == Status.GOOD
        error = Rotation.from_quat(samples.quaternion[place]).inv() * truth.attitude[alone]
        p = samples.covariance_arcsec2[place][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        beyond = squares(error.as_rotvec() * ARCSEC_PER_RADIAN, p)[is_good] > LIMIT
        shares.append(float(beyond.mean()))
        good.append(float(is_good.mean()))
        across.append(math.sqrt(p[-1, 1, 1] + p[-1, 2, 2]))
        if number == 0:
            alone_p = filtered(recorded, mission).covariance_arcsec2[place[-1]]
    share = float(np.mean(shares))
    # Errors of one pass go together: passes are what is counted.
    spread = float(np.std(shares) / math.sqrt(passes))
    figures(passes=passes, share_beyond=share, spread=spread, sigma_across_arcsec=across[0])
    assert share <= SHARE_BEYOND + 5.0 * spread * (passes < PASSES)
    # A star beyond the gate, one in 10,000, makes the next attitudes doubtful.
    assert np.mean(good) > 0.98
    # The stars are used: without them the gyro alone drifts away.
    assert across[0] < 0.5 * math.sqrt(alone_p[3] + alone_p[5])
