"""IM-7: a star's place from one measurement after another."""

import numpy as np
import pytest

from service.features.pictures.centroids.sequential import batch, diffuse
from studies.star_image_report.estimating import least_norm
from studies.star_image_report.measurements import Hump, StopRule, hump_of, recentred

ROUND = Hump(peak=1.0, M=-1.0, L=-1.3, J=0.2)
QUARTIC = Hump(peak=1.0, M=-0.9, L=-1.2, J=0.15, Q=0.35, R=0.3, T=0.4)


def points(rng, number, reach=1.0):
    return rng.uniform(-reach, reach, (2, number))


def measured(rng, hump, u, v, a, b, sigma, background=0.0):
    return hump.intensity(u + a, v + b) + background + rng.normal(0, sigma, u.shape)


def test_five_unknowns_of_a_second_order_image_have_rank_three(rng):
    u, v = points(rng, 200)
    values = np.linalg.svd(ROUND.rows_of_five(u, v), compute_uv=False)
    assert np.all(values[:3] > 1.0)
    assert np.all(values[3:] < 1e-12 * values[0])
    with pytest.raises(np.linalg.LinAlgError, match="5 unknowns"):
        batch(ROUND.rows_of_five(u, v), np.zeros(200), 1.0)


def test_with_a_prior_the_squares_keep_the_prior_s_spread(rng):
    """What no measurement tells, 4,000 of them do not tell either."""
    u, v = points(rng, 4000)
    values = ROUND.remainder(u, v, measured(rng, ROUND, u, v, 0.3, -0.2, 0.02))
    found = diffuse([1.0] * 5).replayed(ROUND.rows_of_five(u, v), values, 0.02**2)
    assert np.all(found.sigma[:2] < 0.001)
    assert np.all(found.sigma[2:] > 0.5)


def test_the_recursion_equals_the_batch(rng):
    """To 1e-10, from a vague start or from the first points solved at once."""
    u, v = points(rng, 60)
    rows = ROUND.rows(u, v)
    values = ROUND.remainder(u, v, measured(rng, ROUND, u, v, 0.3, -0.2, 0.05))
    variances = rng.uniform(0.5, 2.0, 60) * 0.05**2
    whole = batch(rows, values, variances)
    begun = batch(rows[:5], values[:5], variances[:5]).replayed(rows[5:], values[5:], variances[5:])
    assert begun.state == pytest.approx(whole.state, rel=1e-10, abs=1e-10)
    assert begun.covariance == pytest.approx(whole.covariance, rel=1e-9, abs=1e-13)
    vague = diffuse([1e4] * 3).replayed(rows, values, variances)
    assert vague.state == pytest.approx(whole.state, abs=1e-6)
    assert vague.measurements == 60


def test_the_weighted_batch_is_least_squares(rng):
    u, v = points(rng, 40)
    rows, values = ROUND.rows(u, v), rng.normal(size=40)
    expected = np.linalg.lstsq(rows, values, rcond=None)[0]
    assert batch(rows, values, 1.0).state == pytest.approx(expected, rel=1e-10)


def test_fewer_measurements_than_unknowns_give_the_least_norm(rng):
    """6.11 equals the recursion from covariance Q^-1 without noise."""
    u, v = points(rng, 2)
    rows, values = QUARTIC.rows_of_five(u, v), rng.normal(size=2)
    norm = np.diag(rng.uniform(0.5, 2.0, 5))
    state = least_norm(rows, values, norm)
    assert rows @ state == pytest.approx(values)
    start = diffuse(1.0 / np.sqrt(np.diag(norm)))
    assert start.replayed(rows, values, 0.0).state == pytest.approx(state, rel=1e-10, abs=1e-12)
    for _ in range(20):
        other = state + (np.eye(5) - np.linalg.pinv(rows) @ rows) @ rng.normal(size=5)
        assert other @ norm @ other >= state @ norm @ state


def test_scatter_is_what_the_covariance_says(rng):
    """Monte Carlo against 6.26 at 100 points; 1,500 trials, five standard errors."""
    u, v = points(rng, 100)
    rows, trials = ROUND.rows(u, v), 1500
    noise = rng.normal(0, 0.02, (trials, 100))
    left = ROUND.remainder(u, v, ROUND.intensity(u + 0.1, v - 0.05))
    predicted = batch(rows, left, 0.02**2)
    gain = predicted.covariance @ rows.T / 0.02**2
    states = (left + noise) @ gain.T
    assert states.std(axis=0) == pytest.approx(predicted.sigma, rel=5 / np.sqrt(2 * trials))
    one = diffuse([1e3] * 3).replayed(rows, left + noise[0], 0.02**2)
    assert one.state == pytest.approx(states[0], abs=1e-6)


def test_the_estimate_converges_to_the_truth(rng):
    u, v = points(rng, 4000)
    values = ROUND.remainder(u, v, measured(rng, ROUND, u, v, 0.3, -0.2, 0.02))
    found = diffuse([1.0, 1.0, 1.0]).replayed(ROUND.rows(u, v), values, 0.02**2)
    assert np.all(np.abs(found.state[:2] - (0.3, -0.2)) < 5 * found.sigma[:2])
    assert np.all(found.sigma[:2] < 5e-4)


def test_one_point_for_ever_teaches_one_direction_only(rng):
    """The report's argument that the covariance goes to zero is not a proof."""
    row = ROUND.rows(0.5, 0.2)
    stuck = diffuse([1.0] * 3).replayed(np.tile(row, (2000, 1)), np.zeros(2000), 0.02**2)
    assert np.sqrt(row @ stuck.covariance @ row) < 0.001
    assert np.linalg.eigvalsh(stuck.covariance)[-1] > 0.5


def test_the_fourth_order_image_tells_the_squares(rng):
    """Rank five, and a, b, a², a b, b² within what the neglected cubic terms leave."""
    u, v = points(rng, 20_000)
    rows = QUARTIC.rows_of_five(u, v)
    assert np.linalg.cond(rows) < 10.0
    a, b = 0.06, -0.05
    values = QUARTIC.remainder(u, v, QUARTIC.intensity(u + a, v + b))
    found = batch(rows, values, 1.0).state
    assert found == pytest.approx([a, b, a * a, a * b, b * b], abs=6e-4)


def test_each_row_of_five_is_the_second_order_expansion_of_the_image(rng):
    """Phi(u + a, v + b) less Phi(u, v), at every point by itself, written out here in full."""

    def image(u, v):
        M, L, J, Q, R, T = (getattr(QUARTIC, name) for name in "MLJQRT")
        return M * u**2 + 2 * J * u * v + L * v**2 + Q * u**4 + R * v**4 + T * u**2 * v**2

    u, v = points(rng, 50)
    rows = QUARTIC.rows_of_five(u, v)
    for turn in np.arange(0.0, np.pi, 0.3):
        a, b = 1e-3 * np.cos(turn), 1e-3 * np.sin(turn)
        expected = image(u + a, v + b) - image(u, v)
        # What is left is of third order: a few times 1e-9; one term of a row is 1e-7 or more.
        assert rows @ [a, b, a * a, a * b, b * b] == pytest.approx(expected, abs=1e-8)


def test_the_differenced_form_is_unbiased_with_its_factor_two(rng):
    """Without the two, 6.21 gives twice the truth; a background of any height cancels."""
    u, v = points(rng, 40_000)
    values = measured(rng, ROUND, u, v, 0.3, -0.2, 0.02, background=7.0)
    rows, left = ROUND.differenced(u, v, values)
    found = batch(rows, left, 2 * 0.02**2)
    assert np.all(np.abs(found.state - (0.3, -0.2)) < 5 * found.sigma)
    assert np.all(found.sigma < 5e-4)
    as_printed = batch(rows / 2.0, left, 2 * 0.02**2)
    assert as_printed.state == pytest.approx([0.6, -0.4], abs=0.005)


def test_a_constant_background_goes_into_the_third_unknown(rng):
    u, v = points(rng, 4000)
    values = ROUND.remainder(u, v, measured(rng, ROUND, u, v, 0.1, 0.1, 0.02, background=0.5))
    found = batch(ROUND.rows(u, v), values, 0.02**2)
    assert np.all(np.abs(found.state[:2] - 0.1) < 5 * found.sigma[:2])
    assert found.state[2] == pytest.approx(0.5 - 0.01 - 0.013 + 0.004, abs=5 * found.sigma[2])


GAUSSIAN_ERRORS = [(0.25, -0.019), (0.5, -0.036), (1.0, -0.095), (1.5, -0.155)]


def gaussian(u, v):
    return np.exp(-0.5 * (u**2 + v**2))


def gaussian_slopes(u, v):
    return -u * gaussian(u, v), -v * gaussian(u, v)


@pytest.mark.parametrize(("reach", "error"), GAUSSIAN_ERRORS)
def test_points_far_out_on_a_gaussian_bias_the_second_order_image(reach, error):
    """Sigma 1, shifted by .3; points evenly within a circle of this radius."""
    hump = hump_of(gaussian, 1e-3)
    side = np.linspace(-reach, reach, 81)
    u, v = (each.ravel() for each in np.meshgrid(side, side))
    inside = np.hypot(u, v) <= reach
    u, v = u[inside], v[inside]
    values = hump.remainder(u, v, gaussian(u + 0.3, v))
    found = batch(hump.rows(u, v), values, 1.0).state
    assert found[0] - 0.3 == pytest.approx(error, abs=0.004)


def test_the_stop_rule_sees_an_image_that_is_not_the_hump(rng):
    """Consistent where the image is what was assumed; flagged far out on a Gaussian."""
    rule = StopRule(required_sigma=0.003)
    u, v = points(rng, 500)
    good = ROUND.remainder(u, v, measured(rng, ROUND, u, v, 0.1, -0.1, 0.02))
    estimate = batch(ROUND.rows(u, v), good, 0.02**2)
    assert rule.says(ROUND, estimate).done
    assert rule.says(ROUND, estimate).consistent
    few = batch(ROUND.rows(u[:4], v[:4]), good[:4], 0.02**2)
    assert not rule.says(ROUND, few).done
    hump = hump_of(gaussian, 1e-3)
    values = hump.remainder(1.5 * u, 1.5 * v, gaussian(1.5 * u + 0.3, 1.5 * v))
    wrong = batch(hump.rows(1.5 * u, 1.5 * v), values, 0.02**2)
    assert not rule.says(hump, wrong).consistent
    assert StopRule(0.01, inconsistency_sigmas=None).says(hump, wrong).consistent


def test_the_stop_rule_asks_for_both_sigmas(rng):
    """Points along one axis tell that axis alone; then, points along the other."""
    level = Hump(peak=1.0, M=-1.0, L=-1.3)
    rule = StopRule(required_sigma=0.01)
    along, aside = rng.uniform(-1.0, 1.0, 400), rng.uniform(-0.01, 0.01, 400)
    for first, second in (((along, aside), (aside, along)), ((aside, along), (along, aside))):
        estimate = diffuse([1.0] * 3)
        for told, (u, v) in ((False, first), (True, second)):
            values = level.remainder(u, v, measured(rng, level, u, v, 0.1, -0.1, 0.02))
            estimate = estimate.replayed(level.rows(u, v), values, 0.02**2)
            assert min(estimate.sigma[:2]) < 0.01
            assert (max(estimate.sigma[:2]) < 0.01) == told
            assert rule.says(level, estimate).done == told


def test_re_centring_with_the_true_slopes_removes_the_bias(rng):
    u, v = points(rng, 400, 1.5)
    values = gaussian(u + 0.3, v - 0.2) + 0.05
    found = recentred(gaussian, gaussian_slopes, (u, v), values, diffuse([10.0] * 3), 0.02**2)
    assert found.state == pytest.approx([0.3, -0.2, 0.05], abs=1e-6)


def test_a_hump_is_read_off_any_image():
    read = hump_of(lambda u, v: float(QUARTIC.intensity(u, v)), 0.1, fourth=True)
    assert read == Hump(*(pytest.approx(getattr(QUARTIC, k)) for k in ("peak", *"MLJQRT")))
