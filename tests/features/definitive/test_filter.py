"""What the filter promises: Farrenkopf's accuracy, honest covariances, the same bytes in parts."""

import json

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from service.attitude.definitive import Outcome, Status
from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.inputs import (
    AttitudeMeasurements,
    ConstantRateModel,
    DirectionMeasurements,
    FilterSettings,
)
from service.features.definitive.kernels.result import FilterState, joined
from service.gyro.samples import GyroModel, GyroSamples
from service.vectors import attitude_error_arcsec, matrix_from_quaternion
from tests.chance import assert_chi_square, at_least, at_most
from tests.features.definitive.farrenkopf import steady_sigmas
from tests.features.definitive.simulated import (
    ARCSEC,
    attitude_errors,
    attitudes_of,
    directions_of,
    gyro_of,
    inertial_hold,
    nees,
    orbital_rate,
    random_errors,
    slews,
    squares,
    truth_of,
)
from tests.scale import draws

FINE = GyroModel(10**0.5 * 1e-7, 10**0.5 * 1e-10)
MEMS = GyroModel(5e-6, 1e-8)
CASES = {
    "6 and 40 arcsec every second": (FINE, 1, (6.0, 6.0, 40.0), (0.651, 0.651, 1.972)),
    "20 and 25 arcsec every 8 s": (FINE, 8, (20.0, 20.0, 25.0), (2.461, 2.461, 2.856)),
    "a MEMS gyro": (MEMS, 1, (6.0, 6.0, 40.0), (2.396, 2.396, 6.613)),
}


@pytest.mark.parametrize("case", CASES)
def test_the_oracle_is_the_steady_state_that_scipy_finds(case):
    model, every, sigmas, expected = CASES[case]
    v, u = model.sigma_v_rad_s0_5**2, model.sigma_u_rad_s1_5**2
    noise = np.array(
        [[v * every + u * every**3 / 3, -u * every**2 / 2], [-u * every**2 / 2, u * every]]
    )
    phi = np.array([[1.0, -every], [0.0, 1.0]])
    for sigma, steady in zip(sigmas, expected, strict=True):
        r = (sigma * ARCSEC) ** 2
        # In units of r, so that scipy's solver does not meet numbers of 1e-20.
        p = solve_discrete_are(phi.T, np.array([[1.0], [0.0]]), noise / r, np.eye(1))[0, 0] * r
        before, after = steady_sigmas(sigma * ARCSEC, every, v**0.5, u**0.5)
        assert before == pytest.approx(p**0.5, rel=1e-6)
        assert after / ARCSEC == pytest.approx(steady, abs=5e-4)


@pytest.mark.parametrize("case", CASES)
def test_the_covariance_settles_at_farrenkopf_s(case, rng):
    model, every, sigmas, expected = CASES[case]
    truth = truth_of(inertial_hold, 7200.0)
    gyro, _ = gyro_of(truth, model, rng)
    attitudes = attitudes_of(truth, np.arange(0, 7201, every), sigmas, rng)
    # By the usual gate chance rejects one of the last in some hundred draws, and all is in doubt.
    none_rejected = FilterSettings(gate_tail=1e-9, start_gate_tail=1e-9)
    result = filter_attitude(model, gyro, attitudes, settings=none_rejected)
    found = np.sqrt(np.diagonal(result.history.covariance[-1])[:3]) / ARCSEC
    np.testing.assert_allclose(found, expected, rtol=0.03)


@pytest.mark.parametrize("rate", [inertial_hold, orbital_rate, slews])
def test_errors_scatter_as_the_covariance_says(rate, rng):
    """Runs are independent, and so are innovations: their sums are chi-square."""
    truth = truth_of(rate, 1500.0)
    rows = np.arange(0, 1501, 4)
    of_state, of_innovations = [], []
    for _ in range(draws(30, 60)):
        gyro, bias = gyro_of(truth, FINE, rng)
        result = filter_attitude(FINE, gyro, attitudes_of(truth, rows, (6.0, 6.0, 40.0), rng))
        of_state.append(nees(result.history, truth, bias))
        of_innovations.append(result.innovations.nis[1:])
    for epoch in (0, 3, 100, 800, 1500):
        assert_chi_square([each[epoch] for each in of_state], 6)
    assert_chi_square(of_innovations, 3)


def test_a_gyro_with_errors_of_scale_and_alignment_does_not_make_it_overconfident(rng):
    """The same without the model of these errors is far off its covariance."""
    model = GyroModel(FINE.sigma_v_rad_s0_5, FINE.sigma_u_rad_s1_5, 5e-6, 3e-4, 3e-4)
    blind = GyroModel(FINE.sigma_v_rad_s0_5, FINE.sigma_u_rad_s1_5, 5e-6)
    truth = truth_of(slews, 3600.0)
    rows = np.arange(0, 3601, 8)
    known, unknown = [], []
    for _ in range(20):
        gyro, _ = gyro_of(truth, model, rng, errors=random_errors(model, rng))
        measured = attitudes_of(truth, rows, (20.0, 20.0, 25.0), rng)
        for used, squared in ((model, known), (blind, unknown)):
            history = filter_attitude(used, gyro, measured).history
            errors = attitude_errors(history, truth)
            squared.append(np.mean(squares(errors, history.covariance[:, :3, :3])) / 3.0)
    # The errors of a gyro last for its pass: passes are what is counted.
    assert 0.5 < np.mean(known) < 1.0 + 5.0 * np.std(known) / np.sqrt(len(known))
    assert np.mean(unknown) > 3.0


def test_it_follows_the_attitude_through_a_gap_of_the_trackers(rng):
    truth = truth_of(orbital_rate, 4800.0)
    rows = np.concatenate([np.arange(0, 4200, 8), [4800]])
    before_it, squared = [], []
    for _ in range(20):
        gyro, _ = gyro_of(truth, FINE, rng)
        result = filter_attitude(FINE, gyro, attitudes_of(truth, rows, (20.0, 20.0, 25.0), rng))
        assert result.history.status[4799] == Status.GOOD
        error = attitude_errors(result.history, truth)[4799]
        before_it.append(error)
        squared.append(squares(error[None], result.history.covariance[4799:4800, :3, :3])[0])
    assert np.sqrt(np.mean(np.square(before_it))) / ARCSEC < 9.0
    assert_chi_square(squared, 3)


def some_pass(rng, rate=slews, duration_s=1500.0):
    """A pass with stars between attitudes, wrong attitudes and a gap, and its measurements."""
    truth = truth_of(rate, duration_s, 0.5)
    gyro, _ = gyro_of(truth, FINE, rng)
    n = len(truth.time_s)
    rows = np.setdiff1d(np.arange(0, n, 16), np.arange(900, 1100))
    offset = np.where(rng.random((len(rows), 1)) < 0.05, 0.02, 0.0) * np.ones(3)
    measured = attitudes_of(truth, rows, (6.0, 6.0, 40.0), rng, offset)
    stars = directions_of(truth, np.arange(3, n, 40), [0.0, 0.0, 1.0], 6.0, rng)
    keep = np.setdiff1d(np.arange(n), np.arange(2000, 2030))
    # Measurements between two gyro samples, too.
    between = np.where(np.arange(len(rows)) % 3 == 0, 170_000_000, 0)
    model = GyroModel(FINE.sigma_v_rad_s0_5, FINE.sigma_u_rad_s1_5, scale=1e-4)
    moved = AttitudeMeasurements(
        measured.tai_ns + between, measured.quaternion, measured.covariance_rad2
    )
    return model, GyroSamples(gyro.tai_ns[keep], gyro.rate_rad_s[keep]), moved, stars


def part_of(record, begin_ns, end_ns):
    """The rows of a record of arrays whose time is after `begin_ns` and at most `end_ns`."""
    rows = (record.tai_ns > begin_ns) & (record.tai_ns <= end_ns)
    return type(record)(**{name: value[rows] for name, value in vars(record).items()})


def assert_same_bytes(one, other):
    for name, value in vars(one).items():
        assert value.tobytes() == getattr(other, name).tobytes(), name


@pytest.mark.parametrize("parts", [2, 7, 40])
def test_filtering_in_parts_gives_the_same_bytes_as_in_one(parts, rng):
    """Each state goes through JSON, as a record would keep it."""
    model, gyro, attitudes, stars = some_pass(rng)
    whole = filter_attitude(model, gyro, attitudes, stars)
    assert set(whole.innovations.counts().values()) > {0}
    cuts = np.sort(rng.choice(gyro.tai_ns[1:-1], parts - 1, replace=False))
    found, state = [], None
    for begin_ns, end_ns in zip([0, *cuts], [*cuts, gyro.tai_ns[-1]], strict=True):
        given = [part_of(each, begin_ns, end_ns) for each in (gyro, attitudes, stars)]
        found.append(filter_attitude(model, *given, state))
        state = FilterState.from_record(json.loads(json.dumps(found[-1].state.as_record())))
    together = joined(found)
    assert_same_bytes(whole.history, together.history)
    assert_same_bytes(whole.steps, together.steps)
    assert state.as_record() == whole.state.as_record()
    for name in ("innovation_rad", "covariance_rad2", "nis", "outcome"):
        one, other = (getattr(each.innovations, name) for each in (whole, together))
        assert one.tobytes() == other.tobytes(), name


def test_what_was_filtered_does_not_change_with_the_order_of_the_kinds_given(rng):
    model, gyro, attitudes, stars = some_pass(rng)
    again = filter_attitude(model, gyro, directions=stars, attitudes=attitudes)
    assert_same_bytes(filter_attitude(model, gyro, attitudes, stars).history, again.history)


def test_measurements_outside_the_gyro_s_samples_are_counted_and_left_to_the_next_stretch(rng):
    truth = truth_of(inertial_hold, 100.0)
    gyro, _ = gyro_of(truth, FINE, rng)
    attitudes = attitudes_of(truth, np.arange(101), (6.0, 6.0, 40.0), rng)
    part = GyroSamples(gyro.tai_ns[10:90], gyro.rate_rad_s[10:90])
    result = filter_attitude(FINE, part, attitudes)
    assert result.outside == 21
    assert len(result.innovations.nis) == 80
    assert result.state.tai_ns == gyro.tai_ns[89]


def test_one_star_at_a_time_keeps_the_attitude_along_with_the_gyro(rng):
    """After one attitude there are only single stars, about two axes."""
    truth = truth_of(orbital_rate, 3600.0)
    squared, accepted, passes = [], 0, 20
    for _ in range(passes):
        # A bias beyond four sigmas is beyond the gate, where stars alone start nothing anew.
        bias = FINE.bias_sigma_rad_s * np.clip(rng.normal(size=3), -3.0, 3.0)
        gyro, bias = gyro_of(truth, FINE, rng, bias)
        first = attitudes_of(truth, np.array([0]), (6.0, 6.0, 40.0), rng)
        stars = directions_of(truth, np.arange(5, 3600, 10), [0.0, 0.0, 1.0], 6.0, rng)
        result = filter_attitude(FINE, gyro, first, stars)
        accepted += result.innovations.accepted.sum()
        squared.append(nees(result.history, truth, bias))
        sigma = np.sqrt(np.diagonal(result.history.covariance[-1])[:3]) / ARCSEC
        assert sigma.max() < 15.0
    assert accepted > 0.98 * passes * len(stars.tai_ns)
    for epoch in (1000, 2000, 3000):
        assert_chi_square([each[epoch] for each in squared], 6)
    nis = result.innovations.nis[1:]
    assert np.mean(nis) / 2.0 == pytest.approx(1.0, abs=0.25)
    assert (result.innovations.degrees[1:] == 2).all()


def three_stars_and_their_attitude(prior_arcsec, rng):
    """Three stars at right angles after a first attitude, and the attitude that they say."""
    sigma, truth = 10.0 * ARCSEC, truth_of(inertial_hold, 10.0)
    gyro, _ = gyro_of(truth, FINE, rng, np.zeros(3))
    start = attitudes_of(truth, np.array([0]), (prior_arcsec,) * 3, rng)
    measured = truth.attitude[10] * Rotation.from_rotvec(rng.normal(0.0, sigma / 2.0, 3))
    axes, when = np.eye(3), np.full(3, truth.tai_ns[10])
    stars = DirectionMeasurements(when, axes, measured.apply(axes), np.full(3, sigma))
    attitudes = AttitudeMeasurements(
        np.append(start.tai_ns, when[0]),
        np.vstack([start.quaternion, measured.as_quat()]),
        np.concatenate([start.covariance_rad2, np.eye(3)[None] * sigma**2 / 2.0]),
    )
    of_stars = filter_attitude(FINE, gyro, start, stars).history
    of_attitude = filter_attitude(FINE, gyro, attitudes).history
    one, other = (Rotation.from_quat(each.quaternion[-1]) for each in (of_stars, of_attitude))
    return of_stars.covariance[-1], of_attitude.covariance[-1], (one.inv() * other).as_rotvec()


def test_three_stars_of_one_moment_say_what_their_attitude_says(rng):
    of_stars, of_attitude, apart = three_stars_and_their_attitude(60.0, rng)
    assert np.linalg.norm(apart) < 0.01 * 10.0 * ARCSEC
    np.testing.assert_allclose(of_stars, of_attitude, rtol=0.01, atol=1e-3 * of_stars.max())


def test_stars_do_not_make_a_rough_attitude_more_certain_than_their_tangent_planes_allow(rng):
    squared = []
    for _ in range(50):
        of_stars, _, apart = three_stars_and_their_attitude(3600.0, rng)
        squared.append(squares(apart[None], of_stars[None, :3, :3])[0])
    assert np.mean(squared) / 3.0 < 1.5


@pytest.mark.parametrize("every", [1, 10])
def test_without_a_gyro_the_bias_is_minus_the_rate(every, rng):
    truth = truth_of(orbital_rate, 1800.0)
    rows = np.arange(0, 1801, every)
    model = ConstantRateModel(rate_walk_rad_s1_5=1e-9)
    result = filter_attitude(model, attitudes=attitudes_of(truth, rows, (6.0, 6.0, 40.0), rng))
    assert result.history.status[-1] == Status.GOOD
    np.testing.assert_allclose(result.history.rate_rad_s[-1], truth.rate_rad_s[-1], atol=3e-7)
    np.testing.assert_array_equal(result.history.rate_rad_s, -result.history.bias_rad_s)
    errors = attitude_errors(result.history, truth, rows)
    bias = -truth.rate_rad_s[rows]
    bias[0] = bias[1]
    found = squares(
        np.hstack([errors, bias - result.history.bias_rad_s]), result.history.covariance
    )
    assert np.mean(found[len(rows) // 2 :]) < 18.0


def test_without_a_gyro_parts_give_the_same_bytes_too(rng):
    truth = truth_of(orbital_rate, 600.0)
    attitudes = attitudes_of(truth, np.arange(0, 601, 10), (6.0, 6.0, 40.0), rng)
    model, cut_ns = ConstantRateModel(1e-9), int(truth.tai_ns[300])
    whole = filter_attitude(model, attitudes=attitudes)
    first = filter_attitude(model, attitudes=part_of(attitudes, 0, cut_ns))
    rest = part_of(attitudes, cut_ns, attitudes.tai_ns[-1])
    second = filter_attitude(model, attitudes=rest, state=first.state)
    assert_same_bytes(whole.history, joined([first, second]).history)


def test_errors_have_the_axes_and_the_size_of_the_service_s_own(rng):
    """`attitude_error_arcsec` and the filter have the same covariance of one error."""
    truth = truth_of(inertial_hold, 600.0, start=Rotation.random(random_state=3))
    gyro, _ = gyro_of(truth, FINE, rng)
    result = filter_attitude(FINE, gyro, attitudes_of(truth, np.arange(601), (6.0, 6.0, 40.0), rng))
    last = matrix_from_quaternion(result.history.quaternion[-1])
    true = matrix_from_quaternion(truth.attitude[-1].as_quat())
    theta = attitude_errors(result.history, truth)[-1]
    # It is the error from the truth to the estimate; theta goes the other way.
    np.testing.assert_allclose(attitude_error_arcsec(last, true), -theta / ARCSEC, rtol=1e-6)


def test_a_stricter_gate_rejects_as_many_as_chi_square_says(rng):
    """Of a good attitude; while one is doubtful, nothing corrects it, and more are rejected."""
    truth = truth_of(inertial_hold, 3000.0)
    gyro, _ = gyro_of(truth, FINE, rng)
    attitudes = attitudes_of(truth, np.arange(3001), (6.0, 6.0, 40.0), rng)
    result = filter_attitude(FINE, gyro, attitudes, settings=FilterSettings(gate_tail=0.02))
    before = np.searchsorted(result.history.tai_ns, result.innovations.tai_ns[1:]) - 1
    outcome = result.innovations.outcome[1:][result.history.status[before] == Status.GOOD]
    rejected = np.count_nonzero(outcome == Outcome.REJECTED)
    assert at_least(len(outcome), 0.02) <= rejected <= at_most(len(outcome), 0.02)
