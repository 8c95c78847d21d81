"""Scores of attitudes against a truth, held against scipy and against errors that were drawn."""

import io
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.ephemerides.aem import read_aem
from service.features.products.error_chart import errors_picture
from service.features.products.scoring import errors_of, histogram, statistics
from service.vectors import ARCSEC_PER_RADIAN, turned_quaternion
from tests.features.products.series import rows, series, slew, written

SIGMA = np.array([1.5, 2.5, 30.0])
"""Arcseconds; their squares and the diagonal of the covariance of `rows` are set alike."""


def truth_of(*pages):
    return read_aem("truth.aem", io.BytesIO(written("aem", *pages)))


@pytest.fixture
def drawn(rng):
    """A slew, the same with errors of known sigmas, and these errors."""
    n = 4_000
    true = slew(n, rate_deg_per_s=(0.02, 0.03, 0.05))
    covariance = np.array([[2.25, 0.5, 0.0], [0.5, 6.25, 1.0], [0.0, 1.0, 900.0]])
    error = rng.multivariate_normal(np.zeros(3), covariance, n)
    found = turned_quaternion(true, error / ARCSEC_PER_RADIAN)
    page = rows(np.where(found[:, 3:] < 0, -found, found))
    page.covariance_arcsec2[:] = [2.25, 0.5, 0.0, 6.25, 1.0, 900.0]
    return true, page, error


def test_errors_are_those_that_were_made_and_those_of_scipy(drawn):
    true, page, error = drawn
    found = errors_of(series(page).blocks, truth_of(rows(true)))
    np.testing.assert_allclose(found.error_arcsec, error, atol=1e-6)
    # scipy's rotations take body vectors to inertial; the error is of the axes, hence the order.
    by_scipy = (Rotation.from_quat(true).inv() * Rotation.from_quat(page.quaternion)).as_rotvec()
    np.testing.assert_allclose(found.error_arcsec, by_scipy * ARCSEC_PER_RADIAN, atol=1e-6)
    assert found.outside == 0


def test_statistics_are_those_of_the_errors(drawn):
    true, page, error = drawn
    found = statistics(errors_of(series(page).blocks, truth_of(rows(true))))
    for axis, column, sigma in zip("xyz", error.T, SIGMA, strict=True):
        told = found["axes"][axis]
        assert told["mean_arcsec"] == pytest.approx(column.mean(), abs=1e-6)
        assert told["std_arcsec"] == pytest.approx(column.std(), abs=1e-6)
        assert told["max_arcsec"] == pytest.approx(np.abs(column).max(), abs=1e-6)
        assert told["p95_arcsec"] == pytest.approx(np.percentile(np.abs(column), 95), abs=1e-6)
        assert told["predicted_rms_arcsec"] == pytest.approx(sigma, rel=1e-12)
    # Chi-square with three degrees of freedom: mean 3, variance 6.
    assert abs(found["normalized"]["mean"] - 3.0) < 5.0 * np.sqrt(6.0 / len(error))
    assert found["attitudes"] == sum(found["histogram"]["x"]) == len(error)


def test_attitudes_in_gaps_of_the_truth_are_counted_and_left_out(drawn):
    true, page, _ = drawn
    truth = truth_of(rows(true[:1_000]), rows(true[3_000:], "1996-01-10T12:50:00Z"))
    found = errors_of(series(page).blocks, truth)
    assert (len(found.time_ns), found.outside) == (2_000, 2_000)


def test_a_truth_at_other_times_is_interpolated(drawn):
    """At a rate of 0.06 deg/s the truth of every tenth second is as good as that of each."""
    true, page, error = drawn
    coarse = truth_of(rows(true[::10], step_s=10.0))
    found = errors_of(series(page).blocks, coarse)
    assert len(found.time_ns) == 3_991
    np.testing.assert_allclose(found.error_arcsec, error[:3_991], atol=1e-6)


def test_an_exact_attitude_has_no_error_and_a_picture():
    page = rows(slew(20))
    errors = errors_of(series(page).blocks, truth_of(page))
    assert errors.total_arcsec.max() < 1e-9
    assert sum(histogram(errors)["x"]) == 20
    ET.fromstring(errors_picture(errors, "attitudes of <XTE> & others"))


def test_the_picture_shows_every_axis_and_stays_small(drawn):
    true, page, _ = drawn
    errors = errors_of(series(page).blocks, truth_of(rows(true)))
    text = errors_picture(errors, "good attitudes of XTE")
    ET.fromstring(text)
    assert text.count("<circle") <= 9_000
    for axis in "xyz":
        assert f"about {axis}, arcsec" in text
