"""How an alarm lives, held against a plain model that says it another way."""

import itertools

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from service.errors import WrongState
from service.features.alarms import state_machine
from service.features.alarms.windows import Point
from service.trends.limits import LimitSettings, Severity

LIMITS = LimitSettings.model_validate(
    {
        "watch": {"low": -0.2, "high": 5.0},
        "warning": {"low": -0.3, "high": 6.0},
        "critical": {"low": -0.6, "high": 7.0},
    }
)
SEVERITIES = st.sampled_from([None, *Severity])


class Latch(RuleBasedStateMachine):
    """Everything that can happen to an alarm, in any order.

    The model keeps what happened, and derives from it what must be shown.
    """

    def __init__(self):
        super().__init__()
        self.clock = itertools.count(1)
        self.alarm = None
        self.seen_at_worst = False
        self.worst = None
        self.out = None
        self.shelf_end = None
        self.gone = 0
        self.time = 0

    def now(self):
        self.time = next(self.clock)
        return self.text(self.time)

    @staticmethod
    def text(number):
        return f"2026-01-01T00:{number // 60:02d}:{number % 60:02d}.000Z"

    def apply(self, step):
        changes, actions = step
        self.alarm = {**(self.alarm or {}), **changes}
        return actions

    @rule(severity=SEVERITIES, value=st.floats(0, 10))
    def value_comes(self, severity, value):
        now = self.now()
        point = Point(value, now, "b")
        if self.alarm is None or self.alarm["cleared_at"] is not None:
            if severity is not None:
                self.alarm = None
                assert self.apply(state_machine.raised(severity, LIMITS, point, now)) == ["raised"]
                self.worst = self.out = severity
                self.seen_at_worst, self.shelf_end = False, None
            return
        was = self.out
        actions = self.apply(state_machine.observed(self.alarm, severity, LIMITS, point, now))
        self.out = severity
        if severity is not None and severity > self.worst:
            self.worst, self.seen_at_worst = severity, False
            assert "escalated" in actions
        assert ("returned" in actions) == (was is not None and severity is None)
        if self.seen_at_worst and severity is None:
            assert actions[-1] == "cleared"

    @precondition(lambda self: self.alarm is not None)
    @rule()
    def somebody_acknowledges(self):
        now = self.now()
        if self.is_gone() or self.seen_at_worst:
            with pytest.raises(WrongState):
                state_machine.acknowledged(self.alarm, "jb", now)
            return
        actions = self.apply(state_machine.acknowledged(self.alarm, "jb", now))
        self.seen_at_worst = True
        assert actions == (["acknowledged", "cleared"] if self.out is None else ["acknowledged"])

    @precondition(lambda self: self.alarm is not None)
    @rule(seconds=st.integers(1, 20))
    def somebody_shelves(self, seconds):
        now = self.now()
        if self.is_gone():
            with pytest.raises(WrongState):
                state_machine.shelved(self.alarm, "jb", self.text(self.time + seconds), now)
            return
        self.apply(state_machine.shelved(self.alarm, "jb", self.text(self.time + seconds), now))
        self.shelf_end = self.time + seconds

    @precondition(lambda self: self.alarm is not None)
    @rule()
    def somebody_takes_it_off_the_shelf(self):
        if self.is_gone() or self.shelf_end is None:
            with pytest.raises(WrongState):
                state_machine.unshelved(self.alarm)
            return
        self.apply(state_machine.unshelved(self.alarm))
        self.shelf_end = None

    @precondition(lambda self: self.alarm is not None)
    @rule()
    def the_sweep_comes_by(self):
        now = self.now()
        over = not self.is_gone() and self.shelf_end is not None and self.shelf_end <= self.time
        assert self.apply(state_machine.expired(self.alarm, now)) == (
            ["shelf_expired"] if over else []
        )
        if over:
            self.shelf_end = None

    def is_gone(self):
        return self.seen_at_worst and self.out is None

    @precondition(lambda self: self.alarm is not None)
    @invariant()
    def it_shows_what_the_model_says(self):
        now = self.now()
        if self.is_gone():
            wanted = "cleared"
        elif self.shelf_end is not None and self.shelf_end > self.time:
            wanted = "shelved"
        else:
            wanted = "acknowledged" if self.seen_at_worst else "open"
        assert state_machine.state_of(self.alarm, now) == wanted
        assert self.alarm["severity"] == self.worst.word
        assert self.alarm["current_severity"] == (self.out and self.out.word)


Latch.TestCase.settings = settings(max_examples=60, stateful_step_count=30)
TestLatch = Latch.TestCase


def test_unacknowledged_it_stays_however_long_it_is_back_in_limits():
    point = Point(6.5, "2026-01-01T00:00:00.000Z", "b")
    alarm, _ = state_machine.raised(Severity.WARNING, LIMITS, point, point.time)
    for _ in range(50):
        changes, _ = state_machine.observed(
            alarm, None, LIMITS, Point(0.0, point.time, "b"), point.time
        )
        alarm = {**alarm, **changes}
    assert state_machine.state_of(alarm, point.time) == "open"


def test_the_worst_value_is_the_one_furthest_out_on_its_side():
    now = "2026-01-01T00:00:00.000Z"
    alarm, _ = state_machine.raised(Severity.WATCH, LIMITS, Point(-0.25, now, "a"), now)
    for value in (-0.22, -0.4, -0.21):
        step = state_machine.observed(
            alarm, Severity.WATCH, LIMITS, Point(value, now, str(value)), now
        )
        alarm = {**alarm, **step[0]}
    assert alarm["worst_value"] == -0.4
    assert alarm["latest_value"] == -0.21


def test_a_value_that_is_as_bad_as_the_worst_leaves_its_time_and_batch():
    def at(second, value):
        return Point(value, f"2026-01-01T00:00:0{second}.000Z", f"b{second}")

    first, *later = at(1, 5.5), at(2, 5.2), at(3, 5.5)
    alarm, _ = state_machine.raised(Severity.WATCH, LIMITS, first, first.time)
    for point in later:
        changes, _ = state_machine.observed(alarm, Severity.WATCH, LIMITS, point, point.time)
        alarm = {**alarm, **changes}
    worst = tuple(alarm[f"worst_{name}"] for name in ("value", "time", "batch_id"))
    assert worst == (first.value, first.time, first.batch_id)
    assert alarm["latest_batch_id"] == "b3"


def test_on_the_other_side_the_value_that_is_further_beyond_its_bound_is_the_worst():
    now = "2026-01-01T00:00:00.000Z"
    alarm, _ = state_machine.raised(Severity.WATCH, LIMITS, Point(-0.25, now, "a"), now)
    for value in (5.04, 5.5, -0.4):
        step = state_machine.observed(
            alarm, Severity.WATCH, LIMITS, Point(value, now, str(value)), now
        )
        alarm = {**alarm, **step[0]}
    assert alarm["worst_value"] == 5.5
