"""Limits: bounds, hysteresis, minimum count and duration."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from service.features.alarms.windows import Point, SampleWindow, largest_contribution
from service.trends.limits import LimitSettings, RecordedSample, Severity
from service.trends.quantities import default_limits, limited_names

S = 10**9


def limits(**changed):
    wanted = {
        "watch": {"high": 1.0},
        "warning": {"high": 2.0},
        "critical": {"high": 3.0},
        "hysteresis": 0.2,
        "minimum_count": 1,
        "duration_s": 0,
    }
    return LimitSettings.model_validate(wanted | changed)


def judge(settings, values, step_s=10):
    window = SampleWindow()
    found = [window.add((k * step_s * S, value, 1), settings) for k, value in enumerate(values)]
    return [each and each.severity and each.severity.word for each in found]


def test_a_value_is_as_bad_as_the_worst_bound_that_it_is_beyond():
    values = [0.5, 1.0, 1.5, 2.5, 3.5, 0.0]
    assert judge(limits(), values) == [None, None, "watch", "warning", "critical", None]


def test_a_value_must_come_back_by_the_hysteresis():
    assert judge(limits(), [1.1, 0.9, 0.81, 0.79, 0.9]) == ["watch", "watch", "watch", None, None]


def test_low_bounds_hold_as_high_ones_do():
    settings = limits(watch={"low": -1.0, "high": 1.0}, warning={"low": -2}, critical={})
    assert judge(settings, [-0.9, -1.1, -2.5, -0.9, -0.7]) == [
        None,
        "watch",
        "warning",
        "watch",
        None,
    ]


def test_nothing_is_judged_before_there_are_enough():
    settings = limits(minimum_count=3)
    assert judge(settings, [9, 9, 9, 9]) == [None, None, "critical", "critical"]


def test_what_is_judged_is_the_mean_of_the_latest():
    window = SampleWindow()
    settings = limits(minimum_count=4)
    for k, value in enumerate([100, 1, 2, 3, 4]):
        judged = window.add((k, value, 1), settings)
    assert judged.value == 2.5


def test_shares_are_pooled_over_all_stars():
    window, settings = SampleWindow(), limits(minimum_count=2)
    window.add((0, 1, 1), settings)
    assert window.add((1, 0, 9), settings).value == pytest.approx(0.1)


def test_only_what_has_been_out_for_long_enough_counts():
    settings = limits(duration_s=30)
    assert judge(settings, [1.5] * 5) == [None, None, None, "watch", "watch"]
    # Back in between, it begins anew.
    assert judge(settings, [1.5, 1.5, 0.0, 1.5, 1.5, 1.5]) == [None] * 6
    # Each severity has a time of its own.
    assert judge(settings, [1.5, 1.5, 2.5, 2.5, 2.5, 2.5])[3:] == ["watch", "watch", "warning"]


def test_switched_off_nothing_is_out():
    assert judge(limits(enabled=False), [9, 9]) == [None, None]


@given(
    st.lists(st.tuples(st.integers(0, 50), st.integers(0, 5)), min_size=1, max_size=25),
    st.integers(1, 6),
    st.randoms(use_true_random=False),
)
def test_the_value_does_not_depend_on_the_order_in_which_batches_come(samples, count, random):
    settings = limits(minimum_count=count)
    # Times tell batches apart.
    samples = [(time, part, 5) for time, part in dict(samples).items()]

    def last(order):
        window = SampleWindow()
        judged = [window.add(each, settings) for each in order]
        return window.samples, judged[-1] and judged[-1].value

    shuffled = list(samples)
    random.shuffle(shuffled)
    assert last(sorted(samples)) == last(shuffled)


@given(
    st.permutations(range(12)),
    st.integers(2, 5),
    st.integers(1, 12),
    st.sampled_from([{"warning": {"high": 1}}, {"warning": {"low": 1e9}}]),
)
def test_a_mean_leads_to_its_batch_whatever_arrives_later(times, count, evaluated, bounds):
    settings = limits(watch={}, critical={}, minimum_count=count, **bounds)
    # Powers of two have distinct sums: no two means are equal.
    samples = [(time, float(2**k), 1) for k, time in enumerate(times)]
    window = SampleWindow()
    judged = [window.add(each, settings) for each in samples[:evaluated]][-1]
    if judged is None:
        return
    latest, wanted = window.samples[-1], max if "high" in bounds["warning"] else min
    recorded = [RecordedSample(each, seq, str(each[0])) for seq, each in enumerate(samples)]
    recorded = [each for each in recorded if each.sample[0] <= latest[0]]
    point = Point(judged.value, "", str(latest[0]))
    cause = wanted(window.samples, key=lambda each: each[1])
    assert largest_contribution(point, recorded, settings) == str(cause[0])
    missing = [each for each in recorded if each.batch_id != str(cause[0])]
    assert largest_contribution(point, missing, settings) is None


@given(
    st.lists(
        st.tuples(
            st.lists(st.tuples(st.integers(0, 40), st.floats(-2, 1.5)), max_size=15), st.booleans()
        ),
        max_size=8,
    ),
    st.integers(1, 6),
    st.sampled_from([0, 25]),
)
# A single value that is out, while the means are within, makes a later mean of values within out.
@example([([(0, 0.5), (1, 0.5), (2, 1.3)], False), ([(3, 0.95), (4, 0.95)], False)], 3, 0)
# The last mean is out by its last digit; as a difference of two sums it is not.
@example([([(0, -0.8), (1, 0.8), (2, 1.27), (3, 0.93)], False)], 3, 0)
def test_what_is_passed_over_would_have_been_in_limits_one_by_one(groups, count, duration_s):
    """Group after group, whatever order they come in, and where the limits are set anew between."""
    wide, narrow = (
        limits(watch={"low": -size, "high": size}, minimum_count=count, duration_s=duration_s)
        for size in (1.4, 1.0)
    )
    one_by_one, together = SampleWindow(), SampleWindow()
    for values, is_wide in groups:
        settings = wide if is_wide else narrow
        samples = [(time * S, value, 1) for time, value in values]
        before = together.to_json()
        passed = together.add_if_within(samples, settings)
        judged = [one_by_one.add(each, settings) for each in samples]
        if passed:
            assert not any(each and each.severity for each in judged)
            assert not one_by_one.since_ns
        else:
            assert together.to_json() == before
            for each in samples:
                together.add(each, settings)
        assert together.to_json() == one_by_one.to_json()


def test_what_stays_well_in_limits_is_passed_over():
    settings, window = limits(minimum_count=3), SampleWindow()
    assert window.add_if_within([(k, 0.5, 1) for k in range(10)], settings)
    assert not window.add_if_within([(k, 1.5, 1) for k in range(10, 13)], settings)
    # Of batches that come late no mean is worse than the worst of them.
    assert window.add_if_within([(8, 0.9, 1), (1, 1.5, 1)], settings)
    assert not window.add_if_within([(8, 1.1, 1)], settings)


@given(st.lists(st.floats(-5, 5), max_size=30), st.floats(0, 100), st.integers(1, 5))
def test_kept_and_read_again_a_window_goes_on_as_it_was(values, duration_s, count):
    settings = limits(duration_s=duration_s, minimum_count=count)
    whole, kept = SampleWindow(), SampleWindow()
    for k, value in enumerate(values):
        expected = whole.add((k * S, value, 1), settings)
        kept = SampleWindow.from_json(kept.to_json())
        assert kept.add((k * S, value, 1), settings) == expected


@pytest.mark.parametrize(
    "wrong",
    [
        {"watch": {"high": 5.0}},
        {"critical": {"low": 5.0, "high": 4.0}},
        {"hysteresis": -1},
        {"minimum_count": 0},
        {"minimum_count": 10_000},
        {"duration_s": float("inf")},
        {"colour": "red"},
        {"enabled": "yes"},
    ],
)
def test_limits_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValidationError):
        limits(**wrong)


def test_every_limited_quantity_has_a_shipped_limit(missions):
    for mission in missions.values():
        assert set(default_limits(mission)) == set(limited_names())


def test_the_bound_that_is_told_is_the_one_that_was_passed():
    settings = limits(watch={"low": -1.0, "high": 1.0}, warning={}, critical={})
    assert settings.bound(Severity.WATCH, -1.5) == -1.0
    assert settings.bound(Severity.WATCH, 1.5) == 1.0
