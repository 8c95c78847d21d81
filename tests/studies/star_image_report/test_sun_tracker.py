"""IM-5: two error signals from the tails of the sun's cross."""

import pytest

from studies.star_image_report.sun_tracker import SunTracker

TRACKER = SunTracker()


@pytest.mark.parametrize(
    ("off", "signals"),
    [((1.0, 0.0), (0.109, 0.0)), ((0.0, 2.0), (0.0, 0.218)), ((8.0, 8.0), (0.769, 0.769))],
)
def test_each_pair_of_detectors_sees_its_own_axis(off, signals):
    assert TRACKER.errors(*off) == pytest.approx(signals, abs=0.002)


def test_the_signal_is_straight_to_5_arcmin_and_full_at_12():
    slope = TRACKER.slope_per_arcmin()
    assert slope == pytest.approx(0.109, abs=0.002)
    assert TRACKER.errors(5.0, 0.0)[0] == pytest.approx(5 * slope, rel=0.06)
    assert TRACKER.errors(12.0, 0.0)[0] > 0.98
    assert TRACKER.errors(-5.0, 0.0)[0] == pytest.approx(-TRACKER.errors(5.0, 0.0)[0])


def test_there_is_no_crosstalk_up_to_12_arcmin():
    for off in range(13):
        assert abs(TRACKER.errors(float(off), 0.0)[1]) < 1e-4


def test_the_tail_is_faint_and_not_much_narrower_than_the_sun():
    """It protects the detectors, and resolves nothing better: 27 of 32 arcmin."""
    assert TRACKER.attenuation() == pytest.approx(8e-4, rel=0.3)
    assert TRACKER.tail_width_arcmin() == pytest.approx(27.0, abs=0.5)
