"""Stretches, signs and rates of a series, whatever pages it is read in."""

import dataclasses
import itertools

import numpy as np
import pytest

from service.errors import BadInput
from service.features.products.attitudes import SeriesInfo
from service.times import parse_utc, shifted
from service.vectors import (
    attitude_matrices,
    matrix_from_quaternion,
    rotate_about,
    rotation_vectors,
    turned_quaternion,
)
from tests.features.products.series import (
    ABOUT,
    GOLDEN,
    START,
    random_quaternions,
    rows,
    slew,
    whole,
)


def split(page, sizes):
    edges = np.concatenate([[0], np.cumsum(sizes)])
    return [page.taken(slice(a, b)) for a, b in itertools.pairwise(edges)]


def test_a_series_is_the_same_whatever_pages_it_is_read_in(rng):
    n = 400
    steps = rng.choice([1e-7, 1.0, 5.0, 61.0], size=n, p=[0.05, 0.6, 0.25, 0.1])
    times, moment = [], parse_utc(START)
    for step in steps:
        moment = shifted(moment, float(step))
        times.append(moment)
    statuses = rng.choice(["good", "suspect", None], size=n, p=[0.8, 0.1, 0.1]).tolist()
    rates = np.where(rng.random((n, 1)) < 0.3, rng.normal(size=(n, 3)), np.nan)
    page = rows(random_quaternions(rng, n), times, status=statuses, rates=rates)
    for newest in (False, True):
        about = dataclasses.replace(ABOUT, newest_first=newest)
        ordered = page.taken(slice(None, None, -1)) if newest else page
        at_once = whole(ordered, about=about)
        sizes = rng.multinomial(n, np.full(60, 1 / 60))
        for parts in (split(ordered, sizes), split(ordered, [1] * n)):
            other = whole(*parts, about=about)
            for name in [field.name for field in dataclasses.fields(at_once)]:
                one, two = getattr(at_once, name), getattr(other, name)
                if one.dtype == float:
                    np.testing.assert_array_equal(one, two, err_msg=name)
                else:
                    assert one.tolist() == two.tolist(), name


def test_a_stretch_ends_at_a_gap_beyond_the_largest():
    seconds = [0.0, 60.0, 120.000001, 121.0]
    times = [shifted(parse_utc(START), each) for each in seconds]
    assert whole(rows([GOLDEN] * 4, times)).stretch.tolist() == [0, 0, 1, 1]
    about = dataclasses.replace(ABOUT, largest_gap_s=0.5)
    assert whole(rows([GOLDEN] * 4, times), about=about).stretch.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("status", [None, "suspect"])
def test_a_stretch_ends_at_a_batch_without_a_wanted_attitude(status):
    page = rows([GOLDEN] * 5, status=["good", "good", status, "good", "good"])
    assert whole(page).stretch.tolist() == [0, 0, 1, 1]


def test_all_attitudes_are_given_where_they_are_asked_for():
    page = rows([GOLDEN] * 3, status=["good", "suspect", "good"])
    about = dataclasses.replace(ABOUT, status="all")
    assert whole(page, about=about).stretch.tolist() == [0, 0, 0]
    about = dataclasses.replace(ABOUT, status="suspect")
    assert whole(page, about=about).status.tolist() == ["suspect"]


def test_of_attitudes_of_one_moment_the_last_is_given():
    moment = parse_utc(START)
    times = [moment, moment, shifted(moment, 1.0)]
    page = rows([GOLDEN, [0, 0, 0, 1.0], GOLDEN], times)
    assert whole(page).quaternion[:, 2].tolist() == [0.0, GOLDEN[2]]
    backwards = page.taken([2, 1, 0])
    about = dataclasses.replace(ABOUT, newest_first=True)
    assert whole(backwards, about=about).quaternion[:, 2].tolist() == [GOLDEN[2], 0.0]


def test_signs_are_continuous_within_a_stretch_and_attitudes_are_the_same(rng):
    q = slew(1_000, step_s=3.0)
    assert (np.sum(q[1:] * q[:-1], axis=1) < 0).any()
    found = whole(rows(q, step_s=3.0)).quaternion
    assert (np.sum(found[1:] * found[:-1], axis=1) > 0).all()
    assert found[0].tolist() == q[0].tolist()
    assert (np.abs(found) == np.abs(q)).all()


def test_the_rate_of_a_steady_slew_is_derived_in_body_axes():
    rate = [0.3, -0.5, 0.8]
    found = whole(rows(slew(100, rate_deg_per_s=rate)))
    assert found.rate_origin.tolist() == ["derived"] * 100
    np.testing.assert_allclose(found.rate_deg_per_s, np.tile(rate, (100, 1)), atol=1e-12)


def test_a_derived_rate_follows_an_acceleration_to_second_order():
    seconds = np.cumsum([0.0, 1.0, 0.5, 2.0, 1.0, 0.7])
    angle = 0.01 * seconds**2
    q = np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    times = [shifted(parse_utc(START), each) for each in seconds]
    found = np.radians(whole(rows(q, times)).rate_deg_per_s[1:-1, 2])
    np.testing.assert_allclose(found, 0.02 * seconds[1:-1], rtol=1e-9)


def test_a_batch_s_own_rate_is_kept_and_a_lone_attitude_has_none():
    own = [[np.nan] * 3, [1.0, 2.0, 3.0], [np.nan] * 3]
    page = rows(slew(3), rates=own)
    lone = rows([GOLDEN], "1996-01-10T13:00:00Z")
    found = whole(page, lone)
    assert found.rate_origin.tolist() == ["derived", "own", "derived", "none"]
    assert found.rate_deg_per_s[1].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(found.rate_deg_per_s[3]).all()


def test_rotation_vectors_and_matrices_are_those_of_the_conventions(rng):
    q = random_quaternions(rng, 500)
    turn = rng.normal(size=(500, 3))
    turned = turned_quaternion(q, turn)
    a, b = attitude_matrices(q), attitude_matrices(turned)
    for k in range(500):
        np.testing.assert_allclose(a[k], matrix_from_quaternion(q[k]), atol=1e-15)
        r = rng.normal(size=3)
        # A' r = exp(-[w x]) A r
        np.testing.assert_allclose(b[k] @ r, rotate_about(-turn[k], a[k] @ r), atol=1e-13)
    short = np.linalg.norm(turn, axis=1) < np.pi
    np.testing.assert_allclose(rotation_vectors(q, turned)[short], turn[short], atol=1e-13)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("largest_gap_s", 0.0),
        ("largest_gap_s", float("nan")),
        ("largest_gap_s", 1e9),
        ("naif_id", 5),
        ("naif_id", -3_000_000),
        ("object_id", "1995\n074A"),
        ("object_id", ""),
    ],
)
def test_a_bad_setting_is_refused_by_name_and_value(name, value):
    with pytest.raises(BadInput) as refused:
        SeriesInfo("XTE", "live", "2026-01-01T00:00:00.000Z", "0", **{name: value})
    (fault,) = refused.value.faults
    assert fault.field == name
    assert fault.value == repr(value)
