"""The grades of a day: what they promise of accuracy, of gaps, and of what is wrong."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.attitude.definitive import Status, day_bounds, packed, unpacked
from service.features.definitive.day import definitive_day, window_of
from service.features.definitive.kernels.inputs import AttitudeMeasurements, no_attitudes
from service.features.definitive.stretches import (
    attitudes_where,
    usable_attitudes,
    zeros_while_turning,
)
from service.missions.motion import GyroSettings
from service.times import DAY_S, parse_utc
from tests.features.definitive.passes import (
    GYRO,
    MODEL,
    NOON_NS,
    computed_day,
    later,
    mission_with,
    recorded_of,
    spun,
)
from tests.features.definitive.simulated import (
    ARCSEC,
    attitudes_of,
    gyro_of,
    inertial_hold,
    slews,
    squares,
    truth_of,
)
from tests.missions.without_gyro import mission_without_gyro

SIGMAS = (6.0, 6.0, 40.0)


def errors_of(samples, truth, begin_ns):
    """e (n, 3) in radians, as `attitude_error_arcsec`, of samples at whole seconds."""
    rows = np.rint((samples.tai_ns - begin_ns) * 1e-9).astype(int)
    found = Rotation.from_quat(samples.quaternion)
    return -(found.inv() * truth.attitude[rows]).as_rotvec()


def covariances_of(samples):
    """The covariance (n, 3, 3) of samples, in rad^2."""
    upper = samples.covariance_arcsec2 * ARCSEC**2
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


@pytest.fixture(scope="module")
def hours(missions):
    """Three hours of slews with a gap of the gyro of a minute: truth and grades."""
    rng = np.random.default_rng(7)
    truth = truth_of(slews, 3 * 3600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 10801, 8), SIGMAS, rng)
    kept = (truth.time_s < 5000.0) | (truth.time_s > 5060.0)
    recorded = recorded_of(gyro.tai_ns[kept], gyro.rate_rad_s[kept], attitudes)
    return truth, computed_day(recorded, mission_with(missions["XTE"], gyro=GYRO))


def test_both_grades_have_errors_as_their_covariances_say(hours):
    truth, day = hours
    (stretch,) = day.stretches
    assert stretch.model == "gyro"
    for grade, samples in stretch.samples.items():
        settled = samples.tai_ns > NOON_NS + 3600 * 10**9
        e = errors_of(samples, truth, NOON_NS)[settled]
        assert 0.3 < np.mean(squares(e, covariances_of(samples)[settled])) / 3.0 < 2.0, grade
        # In the gap nothing checks a measurement; four after it confirm the attitude again.
        seconds = (samples.tai_ns - NOON_NS) * 1e-9
        until_s = 5064.0 if grade == "smoothed" else 5064.0 + 4 * 8.0
        in_gap = (seconds > 5000.0) & (seconds < until_s)
        assert (samples.status[settled & ~in_gap] == Status.GOOD).all()
        assert (samples.status[(seconds > 5008.0) & (seconds < 5056.0)] == Status.STARTING).all()


def test_the_smoothed_grade_is_the_better_one(hours):
    truth, day = hours
    samples = day.stretches[0].samples
    rms = {}
    for grade, each in samples.items():
        later = each.tai_ns > NOON_NS + 1800 * 10**9
        rms[grade] = np.sqrt(np.mean(errors_of(each, truth, NOON_NS)[later] ** 2)) / ARCSEC
    assert rms["smoothed"] < 0.8 * rms["filtered"] < 0.8 * 10.0


def test_what_became_of_the_record_is_told(hours):
    _, day = hours
    assert day.measurements["started"] == 1
    assert day.measurements["accepted"] == 1350
    assert day.gyro == {
        "samples": 10740,
        "gaps": 1,
        "beyond_largest": 0,
        "not_given": 0,
        "reversed": 0,
    }
    assert 0.9 < day.nis_per_degree < 1.1


def test_a_day_does_not_depend_on_what_lies_beyond_its_window(missions, rng):
    """The window itself counts: six hours before, two after."""
    mission = mission_with(missions["XTE"], gyro=GYRO)
    day = parse_utc("1999-03-02T00:00:00Z").bucket(DAY_S)
    (begin, end), (start, _) = window_of(day), day_bounds(day)
    assert (start.tai_ns - begin.tai_ns, end.tai_ns - start.tai_ns) == (6 * 3600e9, 26 * 3600e9)
    truth = truth_of(slews, 1800.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 1801, 8), SIGMAS, rng)
    shift = start.tai_ns - 900 * 10**9 - NOON_NS
    found = definitive_day(
        later(recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes), shift), mission, day
    )
    (stretch,) = found.stretches
    samples = stretch.samples["filtered"]
    # The quarter of an hour before midnight is of the day before.
    assert len(samples) == 901
    assert samples.tai_ns[0] == start.tai_ns
    assert samples.status[0] == Status.GOOD
    assert found.gyro["samples"] == 901


def test_without_a_gyro_the_rate_is_taken_for_constant(rng):
    truth = truth_of(lambda t: np.tile([0.0, -1e-3, 0.0], (len(t), 1)), 900.0)
    attitudes = attitudes_of(truth, np.arange(0, 901, 5), SIGMAS, rng)
    mission = mission_with(mission_without_gyro("XTE"), motion={"rate_walk_rad_s1_5": 1e-7})
    day = computed_day(recorded_of([], np.zeros((0, 3)), attitudes), mission)
    (stretch,) = day.stretches
    assert stretch.model == "constant_rate"
    samples = stretch.samples["smoothed"]
    assert np.isnan(samples.bias_deg_per_h).all()
    middle = slice(60, 120)
    expected = np.degrees([0.0, -1e-3, 0.0])
    np.testing.assert_allclose(
        samples.rate_deg_per_s[middle], np.tile(expected, (60, 1)), atol=2e-4
    )
    rms = np.sqrt(np.mean(errors_of(samples, truth, NOON_NS)[middle] ** 2)) / ARCSEC
    assert rms < 12.0


def test_samples_of_a_gyro_that_the_mission_does_not_describe_are_not_used(rng):
    truth = truth_of(slews, 600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 601, 8), SIGMAS, rng)
    day = computed_day(
        recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes),
        mission_without_gyro("SWAS"),
    )
    assert [each.model for each in day.stretches] == ["constant_rate"]


def test_a_long_gap_of_the_gyro_is_bridged_at_a_constant_rate(missions, rng):
    truth = truth_of(slews, 7200.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 7201, 8), SIGMAS, rng)
    kept = (truth.time_s < 2000.0) | (truth.time_s > 4000.0)
    recorded = recorded_of(gyro.tai_ns[kept], gyro.rate_rad_s[kept], attitudes)
    day = computed_day(recorded, mission_with(missions["XTE"], gyro=GYRO))
    assert [each.model for each in day.stretches] == ["gyro", "constant_rate", "gyro"]
    for before, after in zip(day.stretches[:-1], day.stretches[1:], strict=True):
        assert before.samples["smoothed"].tai_ns[-1] < after.samples["smoothed"].tai_ns[0]


def test_axes_steps_and_the_moment_of_samples_are_the_mission_s(missions, rng):
    """The same motion as another gyro sends it: four times a second, other axes, instants."""
    truth = truth_of(slews, 1200.0, 0.25)
    gyro, _ = gyro_of(truth, MODEL, rng)
    rows = np.arange(0, 4801, 32)
    attitudes = attitudes_of(truth, rows, SIGMAS, rng)
    axes = {"axes": ["-X", "Z", "Y"]}
    sent = gyro.rate_rad_s * [-1.0, 1.0, 1.0]
    sent = sent[:, [0, 2, 1]]
    same = computed_day(
        recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes),
        mission_with(missions["XTE"], gyro=GYRO),
    )
    other = computed_day(
        recorded_of(gyro.tai_ns, sent, attitudes), mission_with(missions["XTE"], gyro=GYRO | axes)
    )
    one, two = (each.stretches[0].samples["smoothed"] for each in (same, other))
    np.testing.assert_array_equal(one.quaternion, two.quaternion)
    assert len(one) == 1201
    # A median step of .25 s: nothing is a gap, though all is finer than a second.
    assert same.gyro == {
        "samples": 4801,
        "gaps": 0,
        "beyond_largest": 0,
        "not_given": 0,
        "reversed": 0,
    }
    # Of a steady turn the instant and the mean are the same; of its beginning they are not.
    instants = computed_day(
        recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes),
        mission_with(missions["XTE"], gyro=GYRO | {"samples": "instant"}),
    )
    apart = instants.stretches[0].samples["smoothed"].quaternion - one.quaternion
    assert 0.0 < np.abs(apart).max() < 1e-4


def test_samples_beyond_the_largest_rate_are_left_out_and_counted(missions, rng):
    truth = truth_of(slews, 600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    rates = gyro.rate_rad_s.copy()
    rates[100:103] = 1.0
    attitudes = attitudes_of(truth, np.arange(0, 601, 8), SIGMAS, rng)
    day = computed_day(
        recorded_of(gyro.tai_ns, rates, attitudes), mission_with(missions["XTE"], gyro=GYRO)
    )
    assert day.gyro == {
        "samples": 601,
        "gaps": 1,
        "beyond_largest": 3,
        "not_given": 0,
        "reversed": 0,
    }
    errors = errors_of(day.stretches[0].samples["smoothed"], truth, NOON_NS)
    assert np.abs(errors).max() < 120.0 * ARCSEC


def test_a_tracker_that_is_wrong_for_an_hour_does_no_harm_to_good_attitudes(missions, rng):
    truth = truth_of(slews, 4 * 3600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    rows = np.arange(0, 4 * 3600 + 1, 8)
    wrong = (rows > 3600) & (rows <= 7200)
    offset = np.where(wrong[:, None], np.array([0.0, 400.0, 0.0]) * ARCSEC, 0.0)
    attitudes = attitudes_of(truth, rows, SIGMAS, rng, offset=offset)
    day = computed_day(
        recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes),
        mission_with(missions["XTE"], gyro=GYRO),
    )
    assert day.measurements["rejected"] >= 440
    for samples in day.stretches[0].samples.values():
        good = samples.status == Status.GOOD
        assert good.mean() > 0.7
        errors = errors_of(samples, truth, NOON_NS)
        assert squares(errors[good], covariances_of(samples)[good]).max() < 36.0
        # Of the first attitudes of a filter the covariance is large, too.
        settled = good & (samples.tai_ns > NOON_NS + 1800 * 10**9)
        assert np.abs(errors[settled]).max() < 60.0 * ARCSEC
    assert (day.stretches[0].samples["smoothed"].status == Status.GOOD).mean() > 0.99


def test_a_step_of_the_clock_is_named_by_the_status(missions, rng):
    """During a slew a second is a minute of arc and more; trackers and gyro share the clock."""
    truth = truth_of(lambda t: np.tile([0.0, -2e-3, 0.0], (len(t), 1)), 3600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 3601, 8), SIGMAS, rng)
    stepped = np.where(truth.time_s >= 1800.0, 10**9, 0)
    at = np.where(np.arange(0, 3601, 8) >= 1800, 10**9, 0)
    recorded = recorded_of(
        gyro.tai_ns + stepped,
        gyro.rate_rad_s,
        AttitudeMeasurements(
            attitudes.tai_ns + at, attitudes.quaternion, attitudes.covariance_rad2
        ),
    )
    day = computed_day(recorded, mission_with(missions["XTE"], gyro=GYRO))
    samples = day.stretches[0].samples["smoothed"]
    ns = samples.tai_ns - NOON_NS
    moved = ns >= 1801 * 10**9
    rows = np.rint(ns * 1e-9).astype(int) - moved
    found = Rotation.from_quat(samples.quaternion)
    error = np.linalg.norm((found.inv() * truth.attitude[rows]).as_rotvec(), axis=1)
    good = samples.status == Status.GOOD
    assert good.mean() > 0.95
    assert error[good].max() < 120.0 * ARCSEC


def test_attitudes_whose_covariance_says_nothing_are_left_out():
    good = [36.0, 0.0, 0.0, 36.0, 0.0, 1600.0]
    flat = [1.0, 1.0, 0.0, 1.0, 0.0, 1.0]
    covariance = np.array([good, flat, [np.nan] * 6, [0.0] * 6, [1e12, 0, 0, 1e12, 0, 1e12], good])
    q = np.tile([0.0, 0.0, 0.0, 1.0], (6, 1))
    kept, sound = usable_attitudes(np.arange(6), q, covariance)
    assert kept.tai_ns.tolist() == [0, 5]
    assert sound.tolist() == [True, False, False, False, False, True]


def test_measurements_that_cannot_confirm_an_attitude_are_counted(missions, rng):
    truth = truth_of(slews, 600.0)
    attitudes = attitudes_of(truth, np.array([0, 300]), SIGMAS, rng)
    day = computed_day(recorded_of([], np.zeros((0, 3)), attitudes), missions["XTE"])
    assert (day.samples, day.measurements["alone"]) == (0, 2)


def test_nothing_recorded_gives_nothing(missions):
    day = computed_day(recorded_of([], np.zeros((0, 3)), no_attitudes()), missions["XTE"])
    assert (day.samples, day.stretches, day.nis_per_degree) == (0, [], None)


def test_samples_come_back_from_their_bytes(hours):
    samples = hours[1].stretches[0].samples["filtered"].taken(slice(0, 3600))
    data = packed(samples)
    again = unpacked(data, 3600)
    np.testing.assert_array_equal(again.tai_ns, samples.tai_ns)
    np.testing.assert_array_equal(again.quaternion, samples.quaternion)
    np.testing.assert_array_equal(again.status, samples.status)
    for name in ("covariance_arcsec2", "rate_deg_per_s", "bias_deg_per_h", "bias_sigma_deg_per_h"):
        np.testing.assert_allclose(
            getattr(again, name), getattr(samples, name), rtol=1e-7, atol=1e-12
        )
    # Of 117 bytes.
    assert len(data) / 3600 < 75
    assert packed(again) == data


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: b"no", "cannot be decompressed"),
        (lambda data: data[:-9], "cannot be decompressed"),
    ],
)
def test_damaged_bytes_are_named(hours, damage, said):
    data = packed(hours[1].stretches[0].samples["filtered"].taken(slice(0, 10)))
    with pytest.raises(ValueError, match=said):
        unpacked(damage(data), 10)
    with pytest.raises(ValueError, match="are not 11 samples"):
        unpacked(data, 11)


def test_settings_of_a_gyro_have_bounds():
    with pytest.raises(ValueError, match="largest_step_s"):
        GyroSettings(sigma_v_rad_s0_5=1e-7, sigma_u_rad_s1_5=1e-10, largest_step_s=0.0)


@pytest.mark.parametrize("spin", [(0.0, 0.0, 36.0), (0.0, -24.0, 0.0), (18.0, 18.0, 1.0)])
def test_a_spinning_body_has_the_rates_that_its_batches_carried(rng, spin):
    """At 36 deg/s, with a batch every ten seconds, a body looks still; at 24 it looks reversed."""
    truth, rows, recorded, own = spun(spin, rng)
    (stretch,) = computed_day(recorded, mission_without_gyro("XTE")).stretches
    for samples in stretch.samples.values():
        assert (samples.status[10:] == Status.GOOD).all()
        np.testing.assert_allclose(samples.rate_deg_per_s[5:-1], own[5:-1], atol=0.02)
        found = Rotation.from_quat(samples.quaternion)
        e = (found.inv() * truth.attitude[rows]).as_rotvec()
        assert np.mean(squares(e, covariances_of(samples))) / 3.0 < 2.0


def test_rates_that_are_a_little_off_are_corrected_along_the_spin(rng):
    """Across it, a constant error turns with the body: one turn a step leaves nothing of it."""
    _, _, recorded, own = spun((0.0, 0.0, 36.0), rng, carried=(0.0, 0.02, 36.03))
    (stretch,) = computed_day(recorded, mission_without_gyro("XTE")).stretches
    rates = stretch.samples["smoothed"].rate_deg_per_s
    np.testing.assert_allclose(rates[5:-1, 2], own[5:-1, 2], atol=0.01)
    np.testing.assert_allclose(rates[5:-1, :2], own[5:-1, :2], atol=0.03)


def test_random_spinners_are_smoothed_at_their_own_rates(rng):
    """Bodies of up to 60 deg/s about any axis that nutate a little, seen each second to minute."""
    for _ in range(20):
        axis = rng.normal(size=3)
        spin = rng.uniform(0.0, 60.0) * axis / np.linalg.norm(axis)
        step_s = float(rng.choice([1.0, 2.5, 10.0, 30.0, 60.0]))
        truth, rows, recorded, own = spun(spin, rng, step_s, 40 * step_s, wander=0.02)
        (stretch,) = computed_day(recorded, mission_without_gyro("XTE")).stretches
        samples = stretch.samples["smoothed"]
        found = Rotation.from_quat(samples.quaternion)
        e = (found.inv() * truth.attitude[rows]).as_rotvec()
        assert np.mean(squares(e, covariances_of(samples))) / 3.0 < 2.0
        off = np.abs(samples.rate_deg_per_s - own)[3:-1].max()
        # What the body nutates, and what attitudes of 40 arcsec leave over a step.
        assert off < 0.05 + 0.05 / step_s, (spin, step_s)


def test_rates_of_a_body_that_turns_little_change_nothing(rng):
    _, _, recorded, _ = spun((0.0, 0.0, 0.2), rng)
    mission = mission_without_gyro("XTE")
    with_rates, without = (
        computed_day(r, mission) for r in (recorded, replace(recorded, carried_rad_s=None))
    )
    for grade in ("filtered", "smoothed"):
        pair = (each.stretches[0].samples[grade] for each in (with_rates, without))
        assert len({packed(samples) for samples in pair}) == 1


def test_zeros_of_a_gyro_while_the_body_turns_are_none(missions, rng):
    """As a system writes them whose gyro is off; a body at rest may read zero."""
    truth = truth_of(lambda t: np.tile([0.0, 2e-3, 0.0], (len(t), 1)), 3600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 3601, 8), SIGMAS, rng)
    off = (truth.time_s >= 1000.0) & (truth.time_s < 2800.0)
    rates = np.where(off[:, None], 0.0, gyro.rate_rad_s)
    mission = mission_with(missions["XTE"], gyro=GYRO)
    day = computed_day(recorded_of(gyro.tai_ns, rates, attitudes), mission)
    assert day.gyro["not_given"] == np.count_nonzero(off)
    assert [each.model for each in day.stretches] == ["gyro", "constant_rate", "gyro"]
    for stretch in day.stretches:
        samples = stretch.samples["smoothed"]
        e = errors_of(samples, truth, NOON_NS)
        assert np.mean(squares(e, covariances_of(samples))) / 3.0 < 2.0
        assert (samples.status == Status.GOOD).mean() > 0.9
    still = truth_of(inertial_hold, 3600.0)
    attitudes = attitudes_of(still, np.arange(0, 3601, 8), SIGMAS, rng)
    day = computed_day(recorded_of(still.tai_ns, np.zeros((3601, 3)), attitudes), mission)
    assert day.gyro["not_given"] == 0
    assert [each.model for each in day.stretches] == ["gyro"]


@pytest.mark.parametrize("spin_deg_per_s", [36.0, 24.0, -18.0])
def test_zeros_of_a_gyro_take_nothing_from_the_rates_of_a_spinning_body(
    missions, rng, spin_deg_per_s
):
    """At 36 deg/s, with a batch every ten seconds, the attitudes agree with the zeros."""
    truth, rows, recorded, own = spun((0.0, 0.0, spin_deg_per_s), rng)
    gyro_ns = np.arange(NOON_NS, recorded.attitudes.tai_ns[-1] + 1, 10**9)
    off = replace(recorded, gyro_ns=gyro_ns, rates_rad_s=np.zeros((len(gyro_ns), 3)))
    day = computed_day(off, mission_with(missions["XTE"], gyro=GYRO))
    assert day.gyro["not_given"] == len(gyro_ns)
    (stretch,) = day.stretches
    assert stretch.model == "constant_rate"
    for samples in stretch.samples.values():
        np.testing.assert_allclose(samples.rate_deg_per_s[5:-1], own[5:-1], atol=0.02)
        e = (Rotation.from_quat(samples.quaternion).inv() * truth.attitude[rows]).as_rotvec()
        assert np.mean(squares(e, covariances_of(samples))) / 3.0 < 2.0


@pytest.mark.parametrize("rate_rad_s", [2e-3, -1e-3])
def test_a_gyro_that_turns_the_other_way_is_not_used(missions, rng, rate_rad_s):
    """The filter took twice the rate for a bias."""
    truth = truth_of(lambda t: np.tile([0.0, rate_rad_s, 0.0], (len(t), 1)), 3600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 3601, 30), SIGMAS, rng)
    mission = mission_with(missions["XTE"], gyro=GYRO)
    right, wrong = (
        computed_day(recorded_of(gyro.tai_ns, sign * gyro.rate_rad_s, attitudes), mission)
        for sign in (1.0, -1.0)
    )
    assert (right.gyro["reversed"], wrong.gyro["reversed"]) == (0, len(gyro.tai_ns))
    assert [each.model for each in right.stretches] == ["gyro"]
    (stretch,) = wrong.stretches
    assert stretch.model == "constant_rate"
    samples = stretch.samples["smoothed"]
    e = errors_of(samples, truth, NOON_NS)
    assert np.mean(squares(e, covariances_of(samples))) / 3.0 < 2.0


def test_zeros_of_a_gyro_stand_where_batches_carry_the_noise_of_a_body_at_rest(missions, rng):
    still = truth_of(inertial_hold, 900.0)
    attitudes = attitudes_of(still, np.arange(0, 901, 10), SIGMAS, rng)
    recorded = recorded_of(still.tai_ns, np.zeros((901, 3)), attitudes)
    noise = np.radians(rng.normal(0.0, 0.05, (91, 3)))
    day = computed_day(
        replace(recorded, carried_rad_s=noise), mission_with(missions["XTE"], gyro=GYRO)
    )
    assert day.gyro["not_given"] == 0
    assert [each.model for each in day.stretches] == ["gyro"]


def test_batches_of_one_moment_have_an_attitude_whatever_rates_they_carry(rng):
    """As those of several trackers: over no time no rate tells anything."""
    _, _, recorded, _ = spun((0.0, 0.0, 36.0), rng)
    one = replace(
        recorded,
        attitudes=attitudes_where(recorded.attitudes, [0] * 6),
        carried_rad_s=recorded.carried_rad_s[:6],
    )
    (stretch,) = computed_day(one, mission_without_gyro("XTE")).stretches
    samples = stretch.samples["smoothed"]
    assert len(samples) == 1
    assert np.isfinite(samples.covariance_arcsec2).all()


def test_zeros_that_stand_for_none_are_whole_runs_however_many(missions, rng):
    truth = truth_of(lambda t: np.tile([0.0, 2e-3, 0.0], (len(t), 1)), 3600.0)
    attitudes = attitudes_of(truth, np.arange(0, 3601, 8), SIGMAS, rng)
    gyro_ns = attitudes.tai_ns[0] + np.arange(0, 3600 * 10**9, 10**7)
    rates = np.full((len(gyro_ns), 3), 1e-3)
    # Every other sample, and runs of all lengths up to a minute.
    rates[::2] = 0.0
    begin = rng.integers(0, len(gyro_ns), 200)
    for first, length in zip(begin, rng.integers(1, 6000, 200), strict=True):
        rates[first : first + length] = 0.0
    recorded = recorded_of(gyro_ns, rates, attitudes)
    began = time.process_time()
    none = zeros_while_turning(GyroSettings(**GYRO), recorded)
    # A look at each step for each run took a minute.
    assert time.process_time() - began < 2.0
    zero = ~rates.any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], zero, [0]]))).reshape(-1, 2)
    steps = np.searchsorted(recorded.gyro_ns, recorded.attitudes.tai_ns, side="right")
    whole = [run for run in edges if run[1] - run[0] > 1600]
    for begin, end in edges:
        holds_a_step = ((steps[:-1] >= begin) & (steps[1:] <= end)).any()
        assert (none[begin:end] == holds_a_step).all()
    assert len(edges) > 30_000
    assert len(whole) > 10
