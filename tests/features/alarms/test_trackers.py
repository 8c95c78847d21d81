"""Each tracker of a spacecraft with several has limits and alarms of its own."""

import pytest

from service.errors import BadInput
from service.features.alarms.part import Alarms
from service.trends.limits import LimitSettings
from tests.storage.twin import FIRST, SECOND, submission, twin

QUICK = LimitSettings.model_validate(
    {"warning": {"high": 2.0}, "critical": {"high": 30.0}, "minimum_count": 3, "duration_s": 0}
)
OFF = LimitSettings(enabled=False)
NOISY = (1.0, 9.0)


@pytest.fixture
def mission(missions):
    return twin(missions)


@pytest.fixture
def twins(opened, mission):
    app = opened(mission)
    app.part(Alarms).limits.set("XTE", "residual_ratio", QUICK, who="jb")
    return app


def send(app, sky, mission, numbers, **wanted):
    """One after the other: as they come, not in one transaction."""
    for k in numbers:
        app.submissions.submit(submission(sky, mission, f"b{k}", after_s=30.0 * k, **wanted))


def of_ratio(app, state="active"):
    found = app.part(Alarms).page(state=state).items
    return {each.tracker: each for each in found if each.quantity == "residual_ratio"}


def test_the_alarm_names_the_tracker_that_degrades(twins, sky, mission):
    send(twins, sky, mission, range(4))
    assert of_ratio(twins) == {}
    send(twins, sky, mission, range(4, 8), noise_arcsec=NOISY)
    raised = of_ratio(twins)
    assert SECOND in raised
    assert raised[SECOND].state == "open"
    if FIRST in raised:
        assert raised[FIRST].worst.value < raised[SECOND].worst.value


def test_it_returns_and_is_raised_anew_as_the_same_tracker_s(twins, sky, mission):
    """Identity: spacecraft, run, tracker and quantity."""
    send(twins, sky, mission, range(4), noise_arcsec=NOISY)
    first = of_ratio(twins)[SECOND]
    send(twins, sky, mission, range(4, 9))
    back = of_ratio(twins)[SECOND]
    assert (back.id, back.in_limits) == (first.id, True)
    for alarm in of_ratio(twins).values():
        assert twins.part(Alarms).acknowledge(alarm.id, "jb").state == "cleared"
    send(twins, sky, mission, range(9, 13), noise_arcsec=NOISY)
    assert of_ratio(twins)[SECOND].id != first.id
    twins.close()


def test_a_restart_goes_on_with_the_windows_and_alarms_of_trackers(twins, opened, sky, mission):
    send(twins, sky, mission, range(4), noise_arcsec=NOISY)
    before = of_ratio(twins)
    twins.close()
    app = opened(mission)
    send(app, sky, mission, range(4, 9))
    after = of_ratio(app)
    assert after.keys() == before.keys()
    assert after[SECOND].in_limits
    assert after[SECOND].id == before[SECOND].id


def test_a_tracker_has_the_limits_of_its_spacecraft_until_it_has_its_own(twins, sky, mission):
    (ratio,) = (
        each
        for each in twins.part(Alarms).limits.all("XTE", SECOND)
        if each.quantity == "residual_ratio"
    )
    assert (ratio.tracker, ratio.is_default) == (SECOND, True)
    assert ratio.settings == QUICK.model_dump(mode="json")
    set_now = twins.part(Alarms).limits.set("XTE", "residual_ratio", OFF, who="jb", tracker=SECOND)
    assert (set_now.tracker, set_now.is_default) == (SECOND, False)
    history = twins.part(Alarms).limits.get("XTE", "residual_ratio", SECOND)
    assert history.default == QUICK.model_dump(mode="json")
    assert [each.settings["enabled"] for each in history.history] == [False]
    assert twins.part(Alarms).limits.get("XTE", "residual_ratio").limit.settings["enabled"]
    send(twins, sky, mission, range(4), noise_arcsec=NOISY)
    assert SECOND not in of_ratio(twins)
    restored = twins.part(Alarms).limits.set(
        "XTE", "residual_ratio", None, who="jb", tracker=SECOND
    )
    assert restored.is_default
    send(twins, sky, mission, range(4, 8), noise_arcsec=NOISY)
    assert SECOND in of_ratio(twins)


def test_limits_of_what_has_none_are_refused(twins, opened):
    with pytest.raises(BadInput, match="tracker: XTE has STARTRACKER_1, STARTRACKER_2"):
        twins.part(Alarms).limits.all("XTE", "STARTRACKER_3")
    with pytest.raises(BadInput, match="tracker: a tracker has"):
        twins.part(Alarms).limits.get("XTE", "silence_s", SECOND)
    twins.close()
    app = opened()
    (lone,) = app.missions["XTE"].trackers
    with pytest.raises(BadInput, match="tracker: XTE has one tracker"):
        app.part(Alarms).limits.all("XTE", lone.name)


def test_limits_of_a_tracker_are_set_for_the_quantities_that_it_has(twins):
    names = {each.quantity for each in twins.part(Alarms).limits.all("XTE", FIRST)}
    assert names == {
        "ambiguous_share",
        "unmatched_share",
        "suspect_share",
        "residual_rms_arcsec",
        "residual_ratio",
        "magnitude_offset_mag",
        "scale_offset_ppm",
        "alignment_offset_arcsec",
    }
