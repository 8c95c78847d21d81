"""Many passes in which stars are misnamed and whole attitudes wrong, and nothing says so."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.attitude.definitive import Status
from service.attitude.solution import AttitudeSolution, solve_attitude
from service.features.definitive.kernels.inputs import AttitudeMeasurements
from service.vectors import ARCSEC_PER_RADIAN, unit
from tests.chance import at_least, at_most
from tests.features.definitive.passes import (
    GYRO,
    MODEL,
    NOON_NS,
    computed_day,
    mission_with,
    recorded_of,
)
from tests.features.definitive.simulated import ARCSEC, gyro_of, slews, squares, truth_of
from tests.scale import size

PASSES, FEW_PASSES, BATCHES, EVERY_S, STARS = 1000, 10, 100, 8, 5
SIGMA_RAD = 6.0 * ARCSEC
WRONG_STARS, WRONG_ATTITUDES = 0.01, 0.01
LIMIT = 36.0


def stars_about_x(rng):
    """Directions (n, 3) within four degrees of the boresight, body X."""
    aside = np.radians(4.0) * np.sqrt(rng.random((STARS, 1)))
    angle = rng.uniform(0.0, 2.0 * np.pi, (STARS, 1))
    return unit(np.hstack([np.ones((STARS, 1)), aside * np.cos(angle), aside * np.sin(angle)]))


def measured(truth, rows, rng):
    """The good attitudes of some rows: QUEST's of five stars, some of them other ones."""
    kept, solved, wrong = [], [], 0
    for row in rows:
        seen = stars_about_x(rng)
        reference = truth.attitude[row].apply(seen)
        observed = unit(seen + rng.normal(0.0, SIGMA_RAD, seen.shape))
        for k in np.flatnonzero(rng.random(STARS) < WRONG_STARS):
            # The star that was taken for it, seconds to minutes of arc away.
            apart = 10.0 ** rng.uniform(0.7, 2.8) * ARCSEC
            reference[k] = unit(reference[k] + apart * unit(rng.normal(size=3)))
            wrong += 1
        if rng.random() < WRONG_ATTITUDES:
            # Half a minute of arc to a degree.
            off = Rotation.from_rotvec(
                10.0 ** rng.uniform(1.5, 3.5) * ARCSEC * unit(rng.normal(size=3))
            )
            reference = off.apply(reference)
            wrong += 1
        found = solve_attitude(
            observed, reference, np.full(STARS, SIGMA_RAD), np.zeros(STARS, np.int64), ("T",)
        )
        if isinstance(found, AttitudeSolution) and not found.suspect:
            kept.append(row)
            solved.append(found)
    return (
        AttitudeMeasurements(
            truth.tai_ns[kept],
            np.array([each.quaternion for each in solved]),
            np.array([each.covariance_arcsec2 for each in solved]) / ARCSEC_PER_RADIAN**2,
        ),
        wrong,
    )


@pytest.mark.torture
def test_wrong_stars_and_wrong_attitudes_make_no_good_attitude_wrong(missions, seed, figures):
    mission = mission_with(missions["XTE"], gyro=GYRO)
    rng = np.random.default_rng(seed)
    passes = size(PASSES, FEW_PASSES)
    truth = truth_of(slews, EVERY_S * (BATCHES - 1.0))
    rows = np.arange(BATCHES) * EVERY_S
    told = dict.fromkeys(("wrong", "filtered_bad", "smoothed_bad", "diverged", "rejected"), 0)
    good, largest = {"filtered": 0, "smoothed": 0}, 0.0
    for _ in range(passes):
        gyro, _ = gyro_of(truth, MODEL, rng)
        attitudes, wrong = measured(truth, rows, rng)
        day = computed_day(recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes), mission)
        told["wrong"] += wrong
        told["rejected"] += day.measurements["rejected"]
        (stretch,) = day.stretches
        for grade, samples in stretch.samples.items():
            second = np.rint((samples.tai_ns - NOON_NS) * 1e-9).astype(int)
            found = Rotation.from_quat(samples.quaternion)
            error = (truth.attitude[second].inv() * found).as_rotvec()
            upper = samples.covariance_arcsec2 / ARCSEC_PER_RADIAN**2
            full = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
            squared = squares(error, full)
            of_good = squared[np.isin(second, rows) & (samples.status == Status.GOOD)]
            good[grade] += len(of_good)
            told[f"{grade}_bad"] += int(np.sum(of_good > LIMIT))
            largest = max(largest, float(of_good.max(initial=0.0)))
            # A doubt at the end, after a wrong attitude, is part of the covariance.
            told["diverged"] += int(squared[-1] > LIMIT)
    figures(passes=passes, batches=passes * BATCHES, largest=largest, good=good, **told)
    batches = passes * BATCHES
    assert told["wrong"] >= at_least(batches, STARS * WRONG_STARS)
    # One of 100,000; of fewer there may be more by chance.
    allowed = 1 if passes >= PASSES else at_most(batches, 1e-5)
    for grade, count in good.items():
        assert count > 0.9 * batches
        assert told[f"{grade}_bad"] <= allowed, (grade, told, largest)
    assert told["diverged"] == 0
