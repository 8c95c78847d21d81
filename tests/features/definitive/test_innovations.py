"""Innovations: recorded as the filter met them, with the differences from what was smoothed."""

import numpy as np
import pytest
from scipy.stats import chi2

from service.attitude.definitive import MeasuredInnovations, Outcome, packed, unpacked_innovations
from service.errors import BadBatch
from service.features.definitive.kernels.inputs import AttitudeMeasurements
from service.features.definitive.part import Definitive
from service.storage.queries.definitive import latest_innovations
from service.storage.queries.pages import ResultFilter
from service.times import shifted
from tests.features.definitive.passes import (
    GYRO,
    MODEL,
    NOON,
    NOON_NS,
    computed_day,
    mission_with,
    recorded_of,
)
from tests.features.definitive.records import put_pass
from tests.features.definitive.simulated import ARCSEC, attitudes_of, gyro_of, slews, truth_of

SIGMAS = (6.0, 6.0, 40.0)
HOURS = 3


def turned(attitudes, row, arcsec):
    """The attitudes, of which one is turned about the body axis X."""
    q = attitudes.quaternion.copy()
    half = 0.5 * arcsec * ARCSEC
    x, y, z, c = q[row]
    s, k = np.sin(half), np.cos(half)
    q[row] = [k * x + s * c, k * y + s * z, k * z - s * y, k * c - s * x]
    return AttitudeMeasurements(attitudes.tai_ns, q, attitudes.covariance_rad2)


@pytest.fixture(scope="module")
def found(missions):
    """Three hours of slews with one attitude in a thousand 300 arcsec off."""
    rng = np.random.default_rng(5)
    truth = truth_of(slews, HOURS * 3600.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = turned(
        attitudes_of(truth, np.arange(0, HOURS * 3600 + 1, 8), SIGMAS, rng), 700, 300.0
    )
    day = computed_day(
        recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes),
        mission_with(missions["XTE"], gyro=GYRO),
    )
    return day.stretches[0].innovations


def test_a_wrong_attitude_is_rejected_and_its_innovation_says_how_wrong(found):
    (rejected,) = np.flatnonzero(found.outcome == Outcome.REJECTED)
    assert found.tai_ns[rejected] == NOON_NS + 700 * 8 * 10**9
    assert found.innovation_arcsec[rejected, 0] == pytest.approx(300.0, abs=30.0)
    assert found.nis[rejected] > chi2.isf(1e-4, 3)
    # What was not used does not pull the smoothed attitude either.
    assert found.difference_arcsec[rejected, 0] == pytest.approx(300.0, abs=30.0)
    assert found.difference_sigma_arcsec[rejected, 0] > 6.0


def test_chi_square_is_that_of_the_recorded_innovation_and_covariance(found):
    met = np.isfinite(found.nis)
    assert list(np.flatnonzero(~met)) == [0]
    full = found.predicted_arcsec2[met][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    z = found.innovation_arcsec[met]
    own = np.einsum("ni,nij,nj->n", z, np.linalg.inv(full), z)
    np.testing.assert_allclose(own, found.nis[met], rtol=1e-9)


def test_differences_from_the_smoothed_attitude_scatter_as_their_sigmas_say(found):
    """R - P of a measurement that the smoother has used: neither R nor R + P."""
    used = found.is_used
    used[:10] = False
    share = found.difference_arcsec[used] / found.difference_sigma_arcsec[used]
    # One sigma of the rms of so many independent values.
    scatter = 1.0 / np.sqrt(2.0 * share.size)
    assert np.sqrt(np.mean(share**2)) == pytest.approx(1.0, abs=5.0 * scatter)


def test_packing_keeps_times_and_outcomes_and_seven_digits(found):
    again = unpacked_innovations(packed(found), len(found))
    assert again.tai_ns.tolist() == found.tai_ns.tolist()
    assert again.outcome.tolist() == found.outcome.tolist()
    for name in ("innovation_arcsec", "predicted_arcsec2", "nis", "difference_sigma_arcsec"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), rtol=1e-6)
    with pytest.raises(ValueError, match="are not 5 samples"):
        unpacked_innovations(packed(found), 5)


def test_pages_of_innovations_give_each_once_in_order_of_time(app, half_hour):
    put_pass(app, half_hour[1])
    app.part(Definitive).days.smooth("XTE")
    seen, cursor = [], None
    while True:
        page = app.part(Definitive).days.innovations("XTE", limit=50, cursor=cursor)
        seen += page.items
        cursor = page.next_cursor
        if cursor is None:
            break
    assert len(seen) == 226
    times = [each.time for each in seen]
    assert times == sorted(set(times))
    assert (seen[0].outcome, seen[0].chi_square) == ("started", None)
    assert {each.outcome for each in seen[1:]} == {"accepted"}
    assert np.mean([each.chi_square for each in seen[1:]]) == pytest.approx(3.0, abs=0.5)
    part = app.part(Definitive).days.innovations("XTE", start=half_start(10), end=half_start(20))
    assert [each.time for each in part.items] == [
        time for time in times if half_start(10).text <= time < half_start(20).text
    ]
    with pytest.raises(BadBatch, match="cursor"):
        app.part(Definitive).days.innovations("XTE", cursor="1.2")


def half_start(minutes):
    return shifted(NOON, 60.0 * minutes)


def test_no_measurement_makes_no_innovation():
    empty = MeasuredInnovations(
        np.zeros(0, np.int64),
        np.zeros(0, np.int64),
        np.zeros((0, 3)),
        np.zeros((0, 6)),
        np.zeros(0),
        np.zeros((0, 6)),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
    )
    assert len(unpacked_innovations(packed(empty), 0)) == 0


def test_the_innovations_of_a_period_come_from_the_record(app, half_hour):
    put_pass(app, half_hour[1])
    app.part(Definitive).days.smooth("XTE")
    with app.context.reading() as connection:
        whole = latest_innovations(connection, ResultFilter("live", "XTE"), of_gyro=True)
        part = latest_innovations(
            connection, ResultFilter("live", "XTE", half_start(10), half_start(20))
        )
        none = latest_innovations(connection, ResultFilter("none", "XTE"))
    assert [len(each) for each in whole] == [226]
    assert [len(each) for each in part] == [75]
    assert none == []
