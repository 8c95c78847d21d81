"""Trackers with known errors are drawn, and the joint estimate finds these, with honest sigmas."""

import numpy as np
import pytest

from service.errors import BadInput
from service.features.calibration.elimination import eliminate
from service.features.calibration.estimate import calibrate, calibrate_with_chosen_degree
from service.features.calibration.linearise import (
    Model,
    linearised,
    prepared,
    residuals,
    turned_attitudes,
    unknowns_of,
)
from tests import scale
from tests.features.calibration.drawn import (
    MISALIGNED,
    TRACKERS,
    Truth,
    bending,
    drawn,
    error_rms_arcsec,
    everything,
    tracker,
    truth_of,
    varied,
)

PER_AXIS_ARCSEC = 6.0 / np.sqrt(2.0)
"""Of stars with a radial error of 6 arcsec."""


def test_derivatives_are_those_of_finite_differences():
    rng = np.random.default_rng(3)
    _, stars, model = everything(rng, 12)
    unknowns = unknowns_of(stars.trackers, model)
    stars = stars.usable(attitudes_known=False)
    parts = prepared(stars, unknowns, model.reference_temperature_c)
    size = np.where([each.of is None for each in unknowns], 3e-4, 1e-5)
    values = rng.normal(0.0, size)
    turns = np.eye(3)[:, None, :].repeat(stars.batches, axis=1)
    for part in parts:
        found = linearised(part, values, stars.attitude)
        for at, column in enumerate(part.columns):
            step = np.zeros(len(unknowns))
            step[column] = 1e-5
            ahead, behind = (residuals(part, values + s, stars.attitude) for s in (step, -step))
            expected = (ahead - behind) / 2e-5
            np.testing.assert_allclose(
                found.by_unknown[at], expected, atol=2e-3 * np.abs(expected).max()
            )
        for axis in range(3):
            ahead, behind = (
                residuals(part, values, turned_attitudes(stars.attitude, s * turns[axis]))
                for s in (1e-5, -1e-5)
            )
            expected = (ahead - behind) / 2e-5
            np.testing.assert_allclose(
                found.by_attitude[:, :, axis].T, expected, atol=1e-6 * np.abs(expected).max()
            )


def test_eliminated_attitudes_leave_what_a_dense_least_squares_over_everything_gives():
    rng = np.random.default_rng(4)
    _, stars, model = everything(rng, 40)
    unknowns = unknowns_of(stars.trackers, model)
    stars = stars.usable(attitudes_known=False)
    parts = prepared(stars, unknowns, model.reference_temperature_c)
    zero = np.zeros(len(unknowns))
    weight = rng.uniform(0.2, 1.0, len(stars))
    residual = np.hstack([residuals(part, zero, stars.attitude) for part in parts])
    derivatives = [linearised(part, zero, stars.attitude) for part in parts]
    reduced = eliminate(derivatives, residual, weight, len(zero), np.array([0, 15, 40]))
    step, turns, _ = reduced.steps(reduced.normal, residual, weight, np.arange(len(zero)))

    dense = np.zeros((2, len(stars), len(zero) + 3 * stars.batches))
    for part, found in zip(parts, derivatives, strict=True):
        rows = np.arange(part.rows.start, part.rows.stop)
        dense[:, rows[:, None], part.columns] = found.by_unknown.transpose(1, 2, 0)
        for axis in range(3):
            at = len(zero) + 3 * part.batch + axis
            dense[:, rows, at] = found.by_attitude[:, :, axis].T
    root = np.sqrt(np.tile(weight, 2))[:, None]
    matrix = dense.reshape(2 * len(stars), -1) * root
    scaling = np.linalg.norm(matrix, axis=0)
    solution, *_ = np.linalg.lstsq(matrix / scaling, -residual.ravel() * root[:, 0], rcond=None)
    solution /= scaling
    sigma = np.sqrt(np.diag(np.linalg.inv(reduced.normal.matrix)))
    np.testing.assert_allclose(step / sigma, solution[: len(zero)] / sigma, atol=1e-4)
    np.testing.assert_allclose(turns.ravel(), solution[len(zero) :], atol=1e-9)
    left = residual.ravel() * root[:, 0] + matrix @ (scaling * 0.0 + solution)
    assert reduced.normal.squares_after(step) == pytest.approx(float(left @ left), rel=1e-6)


@pytest.mark.torture
def test_a_misalignment_is_found_within_three_sigmas():
    count = max(10, scale.size(100))
    within = 0
    for seed in range(count):
        rng = np.random.default_rng([1, seed])
        stars = drawn(rng, 100, Truth(MISALIGNED, bending(rng)))
        found = calibrate(stars, Model())
        value, sigma = zip(*(found.value_of(f"B alignment {axis}") for axis in "xyz"), strict=True)
        within += bool((np.abs(np.array(value) - MISALIGNED) < 3.0 * np.array(sigma)).all())
    assert within >= 0.97 * count - 0.5


@pytest.mark.torture
def test_errors_are_as_large_as_their_sigmas_say():
    """All parameters of all seeds together; sigmas are right though the stars' are told wrong."""
    errors = []
    for seed in range(max(40, scale.size(400))):
        rng = np.random.default_rng([2, seed])
        truth, stars, model = everything(rng, 60, told_sigma_arcsec=4.0)
        found = calibrate(stars, model)
        assert [each.name for each in found.not_observable] == ["absolute alignment", "A time tag"]
        errors.append((found.value - truth_of(truth, found.unknowns)) / found.sigma)
    assert 0.93 < np.sqrt(np.mean(np.square(errors))) < 1.07


@pytest.mark.parametrize(
    ("batches", "most_arcsec"), [(500, 0.35), pytest.param(2000, 0.17, marks=pytest.mark.slow)]
)
def test_distortion_of_ten_arcsec_is_found(batches, most_arcsec):
    """Over both trackers and some seeds, with radial errors of 6 arcsec."""
    squares = []
    for seed in range(4):
        rng = np.random.default_rng([3, seed])
        truth = Truth(MISALIGNED, bending(rng))
        stars = drawn(rng, batches, truth, sigma_arcsec=PER_AXIS_ARCSEC)
        found = calibrate(stars, Model(degree=3))
        squares += [error_rms_arcsec(found, truth, rng, index) ** 2 for index in (0, 1)]
    assert np.sqrt(np.mean(squares)) < most_arcsec


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_the_degree_is_that_of_the_distortion_and_predicts_what_was_held_out(degree):
    rng = np.random.default_rng([4, degree])
    stars = drawn(rng, 400, Truth(MISALIGNED, bending(rng, degree)))
    found, tried = calibrate_with_chosen_degree(stars, Model(degree=5))
    (chosen,) = (each for each in tried if each.chosen)
    assert chosen.degree == found.model.degree == degree
    assert 0.95 < chosen.residual_over_sigma < 1.05
    if degree:
        assert tried[0].residual_over_sigma > 1.5


def test_a_time_tag_is_told_from_a_misalignment_where_rates_vary():
    rng = np.random.default_rng(5)
    truth = Truth(MISALIGNED, np.zeros((2, 2, 1, 1)), time_tag_s=0.05)
    stars = drawn(rng, 300, truth, rates_deg_per_s=varied(rng, 300))
    found = calibrate(stars, Model(degree=0, time_tag=True))
    value, sigma = found.value_of("B time tag")
    assert sigma < 0.01
    assert value == pytest.approx(0.05, abs=4.0 * sigma)
    z, sigma = found.value_of("B alignment z")
    assert z == pytest.approx(80.0, abs=4.0 * sigma)


@pytest.mark.parametrize("rates", [(0.0, 0.0, 0.0), (0.02, -0.06, 0.03)])
def test_a_time_tag_is_not_observable_where_rates_stay(rates):
    rng = np.random.default_rng(6)
    truth = Truth(MISALIGNED, np.zeros((2, 2, 1, 1)), time_tag_s=0.05)
    stars = drawn(rng, 100, truth, rates_deg_per_s=np.tile(rates, (100, 1)))
    found = calibrate(stars, Model(degree=0, time_tag=True))
    reasons = {each.name: each.reason for each in found.not_observable}
    assert "body rates change too little" in reasons["B time tag"]
    with pytest.raises(BadInput):
        found.value_of("B time tag")


def test_wrong_stars_move_no_estimate_by_a_sigma():
    for seed in range(4):
        found = []
        for wrong in (0.0, 0.05):
            rng = np.random.default_rng([7, seed])
            truth = Truth(MISALIGNED, bending(rng))
            found.append(calibrate(drawn(rng, 300, truth, wrong=wrong), Model()))
        clean, mixed = found
        assert np.abs((mixed.value - clean.value) / clean.sigma).max() < 1.0
        assert 100 < np.sum(~mixed.used) < 150


def test_one_tracker_has_no_alignment_and_no_clock_of_its_own():
    rng = np.random.default_rng(8)
    truth = Truth(MISALIGNED, bending(rng))
    stars = drawn(rng, 100, truth, trackers=TRACKERS[:1])
    found = calibrate(stars, Model(degree=2, time_tag=True))
    assert {each.kind for each in found.unknowns} == {"scale", "distortion"}
    assert [each.name for each in found.not_observable] == ["absolute alignment", "A time tag"]
    assert "A is taken to be where the mission has it" in found.not_observable[0].reason


def test_trackers_that_never_see_stars_together_have_no_alignment():
    rng = np.random.default_rng(9)
    stars = drawn(rng, 100, Truth(MISALIGNED, np.zeros((2, 2, 1, 1))))
    alone = stars.chosen((stars.tracker == 0) == (stars.batch % 2 == 0))
    found = calibrate(alone, Model(degree=0))
    names = [each.name for each in found.not_observable]
    assert names == ["absolute alignment", *(f"B alignment {axis}" for axis in "xyz")]


def test_a_dependence_on_temperature_needs_temperatures():
    rng = np.random.default_rng(10)
    _, stars, model = everything(rng, 60)
    known = calibrate(stars, model)
    value, sigma = known.value_of("B alignment z per deg C")
    assert value == pytest.approx(2.0, abs=4.0 * sigma)
    object.__setattr__(stars, "temperature_c", np.full(len(stars), np.nan))
    names = [each.name for each in calibrate(stars, model).not_observable]
    assert "B alignment z per deg C" in names
    assert "B alignment z" not in names


def test_known_attitudes_show_the_alignment_of_every_tracker():
    rng = np.random.default_rng(11)
    truth = Truth(MISALIGNED, bending(rng, 2))
    stars = drawn(rng, 100, truth, start_off_arcsec=0.0)
    found = calibrate(stars, Model(degree=2, attitudes_known=True))
    assert found.not_observable == ()
    for name, expected in (("A alignment x", 0.0), ("B alignment z", 80.0)):
        value, sigma = found.value_of(name)
        assert value == pytest.approx(expected, abs=4.0 * sigma)


def test_residuals_shrink_to_the_noise():
    rng = np.random.default_rng(12)
    found = calibrate(drawn(rng, 300, Truth(MISALIGNED, bending(rng))), Model())
    assert np.sqrt(np.mean(found.before**2)) > 3.0
    assert found.residual_over_sigma == pytest.approx(1.0, abs=0.05)


def test_too_few_stars_are_refused_by_name():
    rng = np.random.default_rng(13)
    stars = drawn(rng, 3, Truth(MISALIGNED, np.zeros((2, 2, 1, 1))), stars=2)
    with pytest.raises(BadInput, match="too few for"):
        calibrate(stars, Model(degree=3))
    lonely = stars.chosen(np.unique(stars.batch, return_index=True)[1])
    with pytest.raises(BadInput, match="at least one batch"):
        calibrate(lonely, Model(degree=0))


def test_a_degree_beyond_the_largest_is_refused():
    with pytest.raises(BadInput, match="degree: must be from 0 to 7"):
        Model(degree=8)


def test_names_say_tracker_kind_and_term():
    names = [each.name for each in unknowns_of((tracker("T", np.eye(3)),), Model(degree=2))]
    assert names[:3] == ["T scale", "T stretch", "T skew"]
    assert names[3:5] == ["T h P2(x) P0(y)", "T v P2(x) P0(y)"]
