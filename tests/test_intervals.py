"""Intervals hold what they promise, also of values that come in clusters."""

import numpy as np
import pytest
from scipy import stats

from service import intervals

TRIALS = 2000
LEAST_COVERED = 0.90
"""Of 95 %: sixty clusters are few (of high quantiles 93 % are covered), and chance takes 2 %."""


def covered(rng, draw, estimate, truth, trials=TRIALS):
    held = 0
    for _ in range(trials):
        held += estimate(*draw(rng)).holds(truth)
    return held / trials


def clustered_normal(rng, batches=60, each=8, between=0.7):
    """Standard normal values of which half the variance is the batch's."""
    cluster = np.repeat(np.arange(batches), each)
    common = rng.normal(0, between, batches)[cluster]
    return common + rng.normal(0, np.sqrt(1 - between**2), batches * each), cluster


def test_wilson_is_scipys(rng):
    for count in (3, 40, 5000):
        for good in (0, 1, count // 3, count):
            scipys = stats.binomtest(good, count).proportion_ci(method="wilson")
            ours = intervals.wilson(good / count, count)
            assert (ours.low, ours.high) == pytest.approx((scipys.low, scipys.high), abs=1e-12)


def test_the_median_is_bounded_as_by_scipys_sign_test(rng):
    for n in (6, 7, 20, 151):
        values = rng.normal(size=n)
        scipys = stats.quantile_test(values, p=0.5).confidence_interval(0.95)
        ours = intervals.median(values)
        assert (ours.low, ours.high) == (scipys.low, scipys.high)


def test_of_too_few_values_the_median_is_not_bounded():
    assert intervals.median(np.arange(5.0)).high == np.inf


def test_a_share_of_clustered_marks_is_covered(rng):
    truth = float(stats.norm.cdf(-1.0))

    def draw(rng):
        values, cluster = clustered_normal(rng)
        return values < -1.0, cluster

    assert covered(rng, draw, intervals.share_of, truth) >= LEAST_COVERED


def test_that_marks_come_in_clusters_makes_the_interval_wider(rng):
    values, cluster = clustered_normal(rng, between=0.99)
    marks = values < -1.0
    together = intervals.share_of(marks, cluster)
    apart = intervals.share_of(marks, np.arange(len(marks)))
    assert together.high - together.low > 1.5 * (apart.high - apart.low)


def test_a_quantile_of_clustered_values_is_covered(rng):
    truth = float(stats.norm.ppf(0.9))
    assert (
        covered(rng, clustered_normal, lambda v, c: intervals.quantile(v, c, 0.9), truth)
        >= LEAST_COVERED
    )


def test_of_too_few_values_a_high_quantile_is_not_bounded_from_above(rng):
    found = intervals.quantile(rng.normal(size=50), np.arange(50), 0.99)
    assert found.high == np.inf
    assert found.low < found.value


def test_a_line_through_clustered_outliers_is_covered(rng):
    """Offset 0.3 and slope 0.05, where a twentieth of the values are far off."""

    def draw(rng):
        noise, cluster = clustered_normal(rng, between=0.5)
        x = rng.uniform(-2, 2, len(noise))
        y = 0.3 + 0.05 * x + 0.1 * noise
        y += (rng.random(len(y)) < 0.05) * rng.choice((-5.0, 5.0), len(y))
        return np.stack([np.ones(len(x)), x], axis=1), y, cluster

    for place, truth in ((0, 0.3), (1, 0.05)):

        def estimate(*drawn, place=place):
            return intervals.intervals(*intervals.robust_fit(*drawn))[place]

        # A fit takes thirty times as long as a share.
        assert covered(rng, draw, estimate, truth, trials=400) >= LEAST_COVERED


def test_values_that_all_agree_are_bounded_by_themselves():
    design = np.stack([np.ones(60), np.linspace(-1, 1, 60)], axis=1)
    beta, covariance = intervals.robust_fit(
        design, design @ [2.0, -1.0], np.repeat(np.arange(20), 3)
    )
    assert beta == pytest.approx([2.0, -1.0])
    assert np.abs(covariance).max() < 1e-12
