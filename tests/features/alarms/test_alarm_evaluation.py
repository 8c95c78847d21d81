"""Limits held against batches as they are recorded: once each, on every database."""

import json

import pytest
from msgspec import structs
from sqlalchemy import select, update

from service.errors import NotFound, WrongState
from service.features.alarms.part import Alarms
from service.features.alarms.tables import watches
from service.observations.schema import OptionsIn, submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.times import shifted, utc_now
from service.trends.limits import Bounds, LimitSettings

TIGHT = LimitSettings.model_validate(
    {
        "warning": {"high": 0.1},
        "critical": {"high": 0.9},
        "minimum_count": 2,
        "duration_s": 0,
        "hysteresis": 0.0,
    }
)
"""Of the unmatched share: one star of five in two batches is out, none is in."""


@pytest.fixture
def tight(app):
    app.part(Alarms).limits.set("XTE", "unmatched_share", TIGHT, who="jb", comment="for the test")
    return app


def send(app, make, kinds, start=0, **wanted):
    for k, kind in enumerate(kinds, start=start):
        app.submissions.submit(make(f"b{k}", kind=kind, after_s=30.0 * k, **wanted))


def only(app, state="active", **wanted):
    (alarm,) = app.part(Alarms).page(state=state, **wanted).items
    return alarm


def actions(app, alarm):
    return [each.action for each in app.part(Alarms).get(alarm.id).actions]


def test_an_alarm_stays_until_it_is_acknowledged_and_back_in_limits(tight, make):
    send(tight, make, ["good", "spurious", "spurious"])
    alarm = only(tight)
    assert (alarm.state, alarm.severity, alarm.quantity) == (
        "open",
        "warning",
        "unmatched_share",
    )
    assert alarm.raised.bound == 0.1
    assert alarm.raised.time == make(after_s=60).batch.time.text
    assert tight.results.get(alarm.raised.batch_id).answer.batch == "b2"
    send(tight, make, ["good", "good"], start=3)
    back = only(tight)
    assert (back.state, back.in_limits, back.current_severity) == ("open", True, None)
    cleared = tight.part(Alarms).acknowledge(alarm.id, "jb", "dust")
    assert cleared.state == "cleared"
    assert [each.action for each in cleared.actions] == [
        "raised",
        "returned",
        "acknowledged",
        "cleared",
    ]
    said = cleared.actions[2]
    assert (said.who, said.comment) == ("jb", "dust")
    assert tight.part(Alarms).page().items == []
    assert only(tight, "cleared").id == alarm.id


def test_acknowledged_first_it_clears_by_itself_when_it_is_back(tight, make):
    send(tight, make, ["spurious"] * 3)
    alarm = tight.part(Alarms).acknowledge(only(tight).id, "jb")
    assert alarm.state == "acknowledged"
    send(tight, make, ["good"] * 2, start=3)
    assert only(tight, "cleared").id == alarm.id
    # What goes out again is another alarm.
    send(tight, make, ["spurious"] * 2, start=5)
    assert only(tight).id != alarm.id


def test_what_gets_worse_than_it_was_is_open_again(tight, make):
    send(tight, make, ["spurious"] * 2)
    alarm = tight.part(Alarms).acknowledge(only(tight).id, "jb")
    worse = TIGHT.model_copy(update={"critical": TIGHT.critical.model_copy(update={"high": 0.15})})
    tight.part(Alarms).limits.set("XTE", "unmatched_share", worse, who="jb")
    send(tight, make, ["spurious"], start=2)
    found = only(tight)
    assert (found.id, found.state, found.severity) == (alarm.id, "open", "critical")
    assert actions(tight, found) == ["raised", "acknowledged", "escalated"]


def test_a_batch_is_looked_at_once_however_often_it_comes(tight, make):
    for _ in range(4):
        send(tight, make, ["spurious"])
    assert tight.part(Alarms).page().items == []
    send(tight, make, ["spurious"], start=1)
    assert actions(tight, only(tight)) == ["raised"]


@pytest.mark.both_databases
def test_many_at_once_raise_what_they_would_raise_one_by_one(opened, tight, make):
    kinds = ["good", "spurious", "spurious", "good", "good", "spurious", "spurious"]
    tight.runs.watch("bulk")
    tight.runs.watch("single")
    send(tight, make, kinds, run="single")
    tight.submissions.submit_many(
        [make(f"b{k}", kind=kind, after_s=30.0 * k, run="bulk") for k, kind in enumerate(kinds)]
    )
    one, many = (only(tight, run=run) for run in ("single", "bulk"))
    different = ("id", "run", "raised", "worst", "latest", "returned_at")
    assert {k: v for k, v in structs.asdict(one).items() if k not in different} == {
        k: v for k, v in structs.asdict(many).items() if k not in different
    }
    assert actions(tight, one) == actions(tight, many) == ["raised", "returned", "left_again"]
    for which in ("raised", "worst", "latest"):
        assert getattr(one, which).time == getattr(many, which).time
        assert getattr(one, which).value == getattr(many, which).value


def test_back_in_limits_an_alarm_meets_the_latest_of_many_as_it_would_meet_each(tight, make):
    """Most alarms wait for somebody while all is well again, and then nothing is judged twice."""
    send(tight, make, ["spurious"] * 3 + ["good"] * 6)
    together = tight
    together.part(Alarms).limits.set("SWAS", "unmatched_share", TIGHT, who="jb", comment="the same")
    kinds = ["spurious"] * 3 + ["good"] * 6
    others = [
        make(f"s{k}", kind=kind, after_s=30.0 * k, spacecraft="SWAS")
        for k, kind in enumerate(kinds)
    ]
    together.submissions.submit_many(others[:5])
    together.submissions.submit_many(others[5:])
    with together.context.reading():
        """All is evaluated: the other service does not wait for this one."""

    def told(spacecraft):
        alarm = only(tight, spacecraft=spacecraft)
        values = {name: getattr(alarm, name).value for name in ("raised", "worst", "latest")}
        times = {name: getattr(alarm, name).time for name in ("raised", "worst", "latest")}
        return values, times, alarm.in_limits, actions(tight, alarm)

    assert told("SWAS") == told("XTE")
    assert told("XTE")[0]["latest"] == 0.0


def test_what_another_process_kept_of_the_latest_values_is_gone_on_with(tight, make):
    send(tight, make, ["good", "good"])
    with tight.context.reading():
        """Both are evaluated."""

    def forget(connection):
        connection.execute(update(watches).values(state="{}"))

    tight.store.writer.change(forget)
    send(tight, make, ["good"], start=2)
    with tight.context.reading() as connection:
        kept = json.loads(connection.scalar(select(watches.c.state)))
    assert len(kept["unmatched_share"]["samples"]) == 1


def test_alarms_watch_live_batches_and_a_run_when_asked(tight, make):
    send(tight, make, ["spurious"] * 3, run="quiet")
    assert tight.part(Alarms).page(run="*").items == []
    tight.runs.watch("loud")
    send(tight, make, ["spurious"] * 3, run="loud")
    assert only(tight, run="loud").run == "loud"
    assert tight.part(Alarms).page().items == []
    assert {each.run: each.alarms for each in tight.runs.all()} == {
        "loud": True,
        "quiet": False,
    }


@pytest.mark.both_databases
def test_alarms_and_limits_outlive_the_process(opened, make):
    first = opened()
    first.part(Alarms).limits.set("XTE", "unmatched_share", TIGHT, who="jb", comment="kept")
    send(first, make, ["spurious"])
    first.close()
    second = opened()
    # The batch before the restart counts: one more makes two.
    send(second, make, ["spurious"], start=1)
    alarm = second.part(Alarms).shelve(only(second).id, "jb", 60)
    second.close()
    third = opened()
    assert only(third, "shelved").id == alarm.id
    assert third.part(Alarms).limits.all("XTE")[1].comment == "kept"


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_two_processes_look_at_one_spacecraft_in_turn(opened, make):
    one, two = opened(), opened()
    one.part(Alarms).limits.set("XTE", "unmatched_share", TIGHT, who="jb")
    for k in range(6):
        (one, two)[k % 2].submissions.submit(make(f"b{k}", kind="spurious", after_s=30.0 * k))
    alarm = only(two)
    assert only(one) == alarm
    assert actions(two, alarm) == ["raised"]
    assert alarm.latest.time == make(after_s=150).batch.time.text


def test_a_shelf_has_an_end(tight, make, monkeypatch):
    send(tight, make, ["spurious"] * 2)
    alarm = tight.part(Alarms).shelve(only(tight).id, "jb", 30, "until the pass is over")
    assert alarm.state == "shelved"
    assert tight.part(Alarms).page(state="open").items == []
    assert structs.asdict(tight.spacecraft.overview().alarms) == {
        "open": 0,
        "acknowledged": 0,
        "shelved": 1,
        "worst": None,
    }
    assert not tight.part(Alarms).evaluate_by_clock()
    later = shifted(utc_now(), 31 * 60)
    monkeypatch.setattr("service.features.alarms.part.utc_now", lambda: later)
    assert only(tight, "open").id == alarm.id
    assert tight.part(Alarms).evaluate_by_clock()
    assert actions(tight, alarm)[-1] == "shelf_expired"
    assert not tight.part(Alarms).evaluate_by_clock()


@pytest.mark.both_databases
def test_who_comes_late_to_an_alarm_is_told_so(tight, make):
    send(tight, make, ["spurious"] * 2)
    id = only(tight).id
    with pytest.raises(WrongState, match="not shelved"):
        tight.part(Alarms).unshelve(id, "jb")
    tight.part(Alarms).acknowledge(id, "jb")
    with pytest.raises(WrongState, match="acknowledged by jb"):
        tight.part(Alarms).acknowledge(id, "mk")
    tight.part(Alarms).comment(id, "mk", "looked at it")
    send(tight, make, ["good"] * 2, start=2)
    for act in (tight.part(Alarms).acknowledge, tight.part(Alarms).unshelve):
        with pytest.raises(WrongState, match="cleared"):
            act(id, "mk")
    with pytest.raises(NotFound, match="no alarm"):
        tight.part(Alarms).get("01JD0000000000000000000001")


def test_live_silence_is_an_alarm_that_the_next_batch_ends(app, make, monkeypatch):
    send(app, make, ["good"])
    assert not app.part(Alarms).evaluate_by_clock()
    began = utc_now()
    for hours, severity in ((2, "warning"), (7, "critical")):
        monkeypatch.setattr(
            "service.features.alarms.part.utc_now", lambda h=hours: shifted(began, h * 3600)
        )
        assert app.part(Alarms).evaluate_by_clock()
        assert not app.part(Alarms).evaluate_by_clock()
        assert only(app).severity == severity
    silent = only(app)
    assert (silent.quantity, silent.spacecraft) == ("silence_s", "XTE")
    assert silent.raised.time == make().batch.time.text
    monkeypatch.undo()
    send(app, make, ["good"], start=1)
    assert only(app).in_limits
    assert actions(app, silent) == ["raised", "escalated", "returned"]


def test_batches_that_came_while_the_alarms_were_off_are_no_silence(app, make):
    """These are recorded without being evaluated, so that the last one evaluated is older."""
    send(app, make, ["good"])
    long_ago = shifted(utc_now(), -36_000.0).text
    with app.context.store.writer.projection() as connection:
        connection.execute(update(watches).values(received=long_ago))
    assert not app.part(Alarms).evaluate_by_clock()
    send(app, make, ["good"], start=1)
    assert app.part(Alarms).page(state="all").items == []


def test_a_low_bound_of_silence_is_held_as_well(app, make):
    """Batches that come too close after each other."""
    settings = {"watch": {"low": 5.0}, "minimum_count": 1, "duration_s": 0.0}
    limits = LimitSettings.model_validate(settings)
    app.part(Alarms).limits.set("XTE", "silence_s", limits, who="jb", comment=None)
    app.runs.watch("r")
    for k, after_s in enumerate((0.0, 30.0, 31.0)):
        app.submissions.submit(make(f"b{k}", run="r", after_s=after_s))
    alarm = only(app, run="r")
    assert alarm.quantity == "silence_s"
    # The first follows upon itself, and each batch ends the silence before it.
    assert actions(app, alarm) == ["raised", "returned", "left_again", "returned"]


def test_in_a_run_silence_is_a_gap_in_the_batches_own_time(app, make):
    app.runs.watch("r")
    app.submissions.submit(make("b1", run="r"))
    app.submissions.submit(make("b2", run="r", after_s=30))
    assert app.part(Alarms).page(run="r").items == []
    app.submissions.submit(make("b3", run="r", after_s=5000))
    gap = only(app, run="r")
    assert (gap.quantity, gap.raised.value) == ("silence_s", 4970.0)
    assert gap.in_limits


def test_a_batch_dated_far_ahead_is_not_judged(tight, make):
    for name in ("b1", "b2", "b3"):
        text = make(name, kind="spurious").text.replace("1996-01-10T", "2098-01-10T")
        tight.submissions.submit(submission_from_json(text.encode()))
    assert tight.part(Alarms).page().items == []


def test_a_what_if_that_is_adopted_raises_nothing(tight, make):
    send(tight, make, ["good"] * 3)
    options = OptionsIn.model_validate(
        {"identifier": "starid", "tolerances": {"separation_deg": 1e-5}}
    )
    for each in tight.results.page().items:
        tight.results.what_if(each.id, options, adopt=True)
    assert tight.part(Alarms).page().items == []


@pytest.mark.both_databases
def test_every_limit_that_was_set_stays_in_the_history(app):
    shipped = app.part(Alarms).limits.get("XTE", "unmatched_share")
    assert shipped.limit.is_default
    assert shipped.history == []
    app.part(Alarms).limits.set("XTE", "unmatched_share", TIGHT, who="jb", comment="one")
    app.part(Alarms).limits.set("XTE", "unmatched_share", None, who="mk", comment="two")
    found = app.part(Alarms).limits.get("XTE", "unmatched_share")
    assert [(each.who, each.comment) for each in found.history] == [
        ("mk", "two"),
        ("jb", "one"),
    ]
    assert found.history[1].settings == TIGHT.model_dump(mode="json")
    assert found.limit.settings == found.default
    assert app.part(Alarms).limits.get("SWAS", "unmatched_share").history == []


def test_what_happens_to_alarms_and_limits_is_told(tight, make):
    send(tight, make, ["spurious"] * 2)
    tight.part(Alarms).acknowledge(only(tight).id, "jb")
    tight.store.progress.catch_up()
    told = [(each.kind, json.loads(each.data).get("state")) for each in tight.events.after(0, 100)]
    assert [each for each in told if each[0] != "batches"] == [
        ("limit", None),
        ("alarm", "open"),
        ("alarm", "acknowledged"),
    ]


STEEP = LimitSettings.model_validate(
    {
        "warning": {"high": 0.15},
        "critical": {"high": 0.3},
        "minimum_count": 1,
        "duration_s": 60,
        "hysteresis": 0.12,
    }
)
"""Of the unmatched share: out after a minute, and out until it is 0.12 inside the bound."""


def send_stars(app, make, stars, start=0, **wanted):
    """Batches with one false star among so many, 30 s apart: each share is one over the stars."""
    for k, count in enumerate(stars, start=start):
        body = make(f"b{k}", kind="spurious", stars=count, after_s=30.0 * k, **wanted)
        app.submissions.submit(body)


def test_an_escalation_keeps_the_worst_value_that_was_seen(app, make):
    """The share passes the critical bound once; a minute later it is within the hysteresis."""
    app.part(Alarms).limits.set("XTE", "unmatched_share", STEEP, who="jb", comment=None)
    send_stars(app, make, [5, 5, 5, 3, 4, 4])
    alarm = only(app)
    assert actions(app, alarm) == ["raised", "escalated"]
    assert alarm.latest.value == pytest.approx(1 / 4)
    assert alarm.worst.value == pytest.approx(1 / 3)
    assert alarm.worst.time == make(after_s=90).batch.time.text
    # The side of the bound is that of the worst value: a smaller share is never a worse one.
    send_stars(app, make, [5, 4], start=6)
    assert only(app).worst.value == pytest.approx(1 / 3)


def test_the_worst_value_of_a_new_alarm_lies_beyond_its_bound(app, make):
    """The value that passed the bound counts, not the one at which the minute was over."""
    limits = STEEP.model_copy(update={"critical": Bounds()})
    app.part(Alarms).limits.set("XTE", "unmatched_share", limits, who="jb", comment=None)
    send_stars(app, make, [3, 8, 8])
    alarm = only(app)
    assert (alarm.raised.value, alarm.raised.bound) == (pytest.approx(1 / 8), 0.15)
    assert alarm.worst.value == pytest.approx(1 / 3)
    assert alarm.worst.time == make(after_s=0).batch.time.text
    assert app.results.get(alarm.worst.batch_id).answer.batch == "b0"
    send_stars(app, make, [8, 7], start=3)
    assert only(app).worst.value == pytest.approx(1 / 3)
    send_stars(app, make, [2], start=5)
    # Neither of two stars is identified where one is false.
    assert only(app).worst.value == 1.0


def test_a_bound_that_was_widened_is_out_only_beyond_it(app, make):
    """The hysteresis is of a bound that was passed; a value inside a new one is in limits."""
    at_once = STEEP.model_copy(update={"critical": Bounds(), "duration_s": 0.0})
    app.part(Alarms).limits.set("XTE", "unmatched_share", at_once, who="jb", comment=None)
    send_stars(app, make, [5])
    assert not only(app).in_limits
    wider = at_once.model_copy(update={"warning": Bounds(high=0.25)})
    app.part(Alarms).limits.set("XTE", "unmatched_share", wider, who="jb", comment=None)
    send_stars(app, make, [5], start=1)
    assert only(app).in_limits


@pytest.mark.parametrize("kind", ["good", "spurious"])
def test_an_older_batch_that_comes_late_does_not_become_the_latest(tight, make, kind):
    """Out of limits or back in them: the latest batch is the one of the latest time."""
    later = "spurious" if kind == "spurious" else "good"
    send(tight, make, ["spurious", "spurious", "spurious", later, later], start=10)
    before = only(tight)
    send(tight, make, [kind], start=3)
    assert only(tight).latest == before.latest
    # One that takes a place among the latest two changes their value, and not their time.
    tight.submissions.submit(make("between", kind="good", after_s=30.0 * 13.5))
    after = only(tight).latest
    assert after.time == before.latest.time == make(after_s=30.0 * 14).batch.time.text
    assert after.batch_id == before.latest.batch_id
    assert after.value == pytest.approx(0.1 if kind == "spurious" else 0.0)


def test_an_alarm_that_a_late_batch_raises_is_of_the_latest_batch(tight, make):
    """The value is that of the latest two, whichever came first."""
    tight.submissions.submit(make("new", kind="spurious", after_s=300))
    tight.submissions.submit(make("old", kind="spurious", after_s=30))
    alarm = only(tight)
    for which in ("raised", "worst", "latest"):
        assert getattr(alarm, which).time == make(after_s=300).batch.time.text
        assert tight.results.get(getattr(alarm, which).batch_id).answer.batch == "new"


def test_an_older_batch_ends_a_silence_without_becoming_the_latest(app, make, monkeypatch):
    send(app, make, ["good"], start=5)
    began = utc_now()
    monkeypatch.setattr("service.features.alarms.part.utc_now", lambda: shifted(began, 2 * 3600))
    assert app.part(Alarms).evaluate_by_clock()
    before = only(app).latest
    monkeypatch.undo()
    send(app, make, ["good"])
    found = only(app)
    assert found.in_limits
    assert found.latest.time == before.time


def test_an_older_batch_of_a_run_is_no_gap_of_less_than_nothing(app, make):
    settings = {"watch": {"low": 5.0}, "minimum_count": 1, "duration_s": 0.0}
    limits = LimitSettings.model_validate(settings)
    app.part(Alarms).limits.set("XTE", "silence_s", limits, who="jb", comment=None)
    app.runs.watch("r")
    app.submissions.submit(make("b1", run="r"))
    cleared = app.part(Alarms).acknowledge(only(app, run="r").id, "jb")
    assert cleared.state == "cleared"
    app.submissions.submit(make("b2", run="r", after_s=600))
    app.submissions.submit(make("b3", run="r", after_s=300))
    assert app.part(Alarms).page(run="r").items == []


# ---- the sample telemetry ------------------------------------------------------------------------


def submitted(app, spacecraft, run, wanted):
    app.runs.watch(run)
    mission = app.missions[spacecraft]
    drawn = draw_pass(mission, app.sky, wanted)
    app.submissions.submit_many(
        [submission_from_json(json.dumps(each.batch).encode(), run=run) for each in drawn]
    )
    stretches = dict(
        zip(
            [each.time for each in app.results.page(run=run, limit=500).items][::-1],
            [each.kind for each in wanted.stretches(mission)],
            strict=True,
        )
    )
    found = app.part(Alarms).page(run=run, state="all").items
    return [(each, stretches[each.raised.time]) for each in found]


@pytest.mark.parametrize(
    "spacecraft",
    ["XTE", *(pytest.param(name, marks=pytest.mark.slow) for name in ("SWAS", "SOHO"))],
)
@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_the_sample_raises_an_alarm_in_its_growing_attitude_error(opened, spacecraft, seed):
    """And none in what comes before, nor for good."""
    app = opened()
    found = submitted(app, spacecraft, "sample", Pass(batches=160, seed=seed % 1000))
    angle = [each for each in found if each[0].quantity == "a_priori_angle_deg"]
    ((alarm, stretch),) = angle
    assert stretch == "attitude_error"
    assert alarm.in_limits, "after the stretch it is back"
    assert app.part(Alarms).acknowledge(alarm.id, "jb", "seen").state == "cleared"
    nominal = Pass(batches=120, seed=seed % 1000 + 1, troubles=NO_TROUBLES)
    # Where a pass meets a part of the sky with one star, alarms about missing attitudes are right.
    raised = {alarm.quantity for alarm, _ in submitted(app, spacecraft, "nominal", nominal)}
    assert raised <= {"no_attitude_share", "unmatched_share"}


def test_a_limit_that_is_set_closes_no_limit_of_another_spacecraft(app):
    """Nor one of another quantity."""
    before = app.part(Alarms).limits.set(
        "SWAS", "unmatched_share", TIGHT, who="jb", comment="theirs"
    )
    other = app.part(Alarms).limits.set("XTE", "ambiguous_share", TIGHT, who="jb", comment="other")
    app.part(Alarms).limits.set("XTE", "unmatched_share", TIGHT, who="mk", comment="first")
    app.part(Alarms).limits.set("XTE", "unmatched_share", None, who="mk", comment="second")
    assert app.part(Alarms).limits.get("SWAS", "unmatched_share").limit == before
    assert app.part(Alarms).limits.get("XTE", "ambiguous_share").limit == other
    assert app.part(Alarms).limits.get("XTE", "unmatched_share").limit.comment == "second"
