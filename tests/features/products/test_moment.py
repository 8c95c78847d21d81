"""The attitude at a moment, nearest or interpolated, with its error."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from service.errors import NotFound
from service.features.products.moment import attitude_at
from service.times import parse_utc, shifted
from tests.features.products.series import ABOUT, GOLDEN, START, rows, slew

PAGES = [rows(slew(10)), rows(slew(5), "1996-01-10T12:05:00Z")]


def at(seconds, method="interpolated", pages=PAGES, begin=START):
    return attitude_at(ABOUT, pages, shifted(parse_utc(begin), seconds), method)


def test_between_two_attitudes_it_is_that_of_scipy():
    keys = Slerp(np.arange(10.0), Rotation.from_quat(slew(10)))
    for seconds in (0.25, 4.5, 8.999):
        found = at(seconds)
        wanted = keys([seconds]).as_quat()[0]
        assert abs(np.dot(found.quaternion, wanted)) == pytest.approx(1.0, abs=1e-14)
        assert np.linalg.norm(found.quaternion) == pytest.approx(1.0, abs=1e-15)
        # The body turns at a constant rate, so that the motion adds nothing.
        assert found.motion_arcsec == pytest.approx(0.0, abs=1e-6)
        assert len(found.ids) == 2


def test_in_the_middle_of_two_independent_attitudes_the_variance_is_half():
    covariance = np.array(at(3.5).covariance_arcsec2)
    single = np.array(at(3.0).covariance_arcsec2)
    np.testing.assert_allclose(covariance, single / 2.0, rtol=1e-9)
    assert single[0][0] == 1.5
    assert single[2][2] == 30.0


def test_an_attitude_of_the_moment_itself_is_given_as_it_is():
    for method in ("nearest", "interpolated"):
        found = at(4.0, method)
        assert found.offset_s == found.motion_arcsec == 0.0
        assert abs(np.dot(found.quaternion, slew(10)[4])) == pytest.approx(1.0, abs=1e-15)


def test_the_nearest_has_the_angle_that_the_body_turns_until_the_moment():
    found = at(3.25, "nearest")
    assert found.offset_s == pytest.approx(-0.25, abs=1e-9)
    rate_deg_per_s = math.sqrt(0.3**2 + 0.5**2 + 0.8**2)
    assert found.motion_arcsec == pytest.approx(rate_deg_per_s * 0.25 * 3600.0, rel=1e-9)
    assert at(40.0, "nearest").offset_s == pytest.approx(-31.0, abs=1e-9)


def test_a_body_that_speeds_up_has_an_error_of_motion_that_holds_the_true_one():
    """Turning about Z by t^2 / 10 degrees: interpolated in the middle, 90 arcsec too far."""
    angle = np.radians(0.1 * np.arange(20.0) ** 2) / 2.0
    zero = np.zeros(20)
    q = np.column_stack([zero, zero, np.sin(angle), np.cos(angle)])
    found = at(9.5, pages=[rows(q)])
    true = math.radians(0.1 * 9.5**2) / 2.0
    error = 2.0 * math.degrees(math.atan2(found.quaternion[2], found.quaternion[3]) - true) * 3600
    assert error == pytest.approx(90.0, rel=1e-6)
    assert found.motion_arcsec == pytest.approx(90.0, rel=1e-6)


@pytest.mark.parametrize("seconds", [-1.0, 10.0, 150.0, 290.0])
def test_nothing_is_interpolated_outside_a_stretch(seconds):
    with pytest.raises(NotFound, match=r"good attitudes of XTE in run live at 1996-01-10T"):
        at(seconds)


def test_a_batch_without_a_good_attitude_between_breaks_the_stretch():
    q = slew(5)
    page = rows(q, status=["good", "good", "suspect", "good", "good"])
    with pytest.raises(NotFound, match="within no stretch"):
        at(2.5, pages=[page])
    assert at(0.5, pages=[page]).method == "interpolated"
    assert at(2.4, "nearest", pages=[page]).offset_s == pytest.approx(0.6, abs=1e-9)


def test_without_any_attitude_nothing_is_found():
    for pages in ([], [rows([GOLDEN], status=None)]):
        with pytest.raises(NotFound, match="none is within the largest gap"):
            at(0.0, "nearest", pages)
