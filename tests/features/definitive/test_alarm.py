"""The alarm of rejected attitudes: raised by a smoothed day, and over when they agree again."""

from dataclasses import replace

import numpy as np
import pytest

from service.features.alarms.part import Alarms
from service.features.definitive.kernels.inputs import AttitudeMeasurements
from service.features.definitive.part import Definitive
from service.trends.limits import above
from tests.features.definitive.passes import NOON
from tests.features.definitive.records import put_pass
from tests.features.definitive.simulated import ARCSEC

QUICK = above(0.02, 0.05, 0.2, hysteresis=0.005, minimum_count=50, duration_s=0.0)


def turned(attitudes, rows, arcsec=300.0):
    """Some of the attitudes are turned about the body axis X."""
    q = attitudes.quaternion.copy()
    s, c = np.sin(0.5 * arcsec * ARCSEC), np.cos(0.5 * arcsec * ARCSEC)
    x, y, z, w = q[rows].T
    q[rows] = np.stack([c * x + s * w, c * y + s * z, c * z - s * y, c * w - s * x], axis=1)
    return AttitudeMeasurements(attitudes.tai_ns, q, attitudes.covariance_rad2)


def alarms_of(app, run="live"):
    found = app.part(Alarms).page(run=run, state="all").items
    return [each for each in found if each.quantity == "innovation_rejected_share"]


@pytest.fixture
def put(app, half_hour):
    """Records the half hour with some attitudes wrong, and smooths it."""
    app.part(Alarms).limits.set("XTE", "innovation_rejected_share", QUICK, who="jb", comment=None)

    def put_with(rows, run="live"):
        recorded = half_hour[1]
        put_pass(app, replace(recorded, attitudes=turned(recorded.attitudes, rows)), run=run)
        return app.part(Definitive).days.smooth("XTE", run=run)

    return put_with


def test_one_wrong_attitude_in_fifty_raises_nothing(app, put):
    put([20, 120])
    assert alarms_of(app) == []


def test_a_tracker_that_is_wrong_at_the_end_of_the_day_raises_an_alarm(app, put):
    put(range(205, 226))
    (alarm,) = alarms_of(app)
    assert (alarm.spacecraft, alarm.severity) == ("XTE", "critical")
    assert alarm.current_severity == "critical"
    assert alarm.worst.value == pytest.approx(21 / 50)
    assert alarm.raised.time > NOON.text


def test_what_is_over_within_the_day_is_told_and_has_returned(app, put):
    put(range(60, 70))
    (alarm,) = alarms_of(app)
    assert alarm.current_severity is None
    assert alarm.worst.value == pytest.approx(10 / 50)


def test_the_same_record_again_and_runs_without_alarms_raise_nothing(app, put):
    put(range(205, 226))
    before = alarms_of(app)
    app.part(Definitive).days.smooth("XTE")
    assert alarms_of(app) == before
    put(range(205, 226), run="pass")
    assert alarms_of(app, "pass") == []


def test_the_preview_evaluates_the_smoothed_days(app, put):
    put(range(60, 70))
    told = app.part(Alarms).limits.preview("XTE", "innovation_rejected_share", QUICK)
    assert told.batches == 226
    assert told.proposed.alarms == 1
    (excursion,) = told.proposed.excursions
    assert excursion.end is not None
    assert excursion.worst == pytest.approx(10 / 50)
