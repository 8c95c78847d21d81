"""A preview of limits says what the evaluation of the same batches did, or would do."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import BadInput
from service.features.alarms.part import Alarms
from service.features.alarms.windows import SampleWindow, preview_of, preview_of_gaps
from service.trends.limits import LimitSettings, Severity
from tests.storage.twin import SECOND, submission, twin

S = 10**9
TIGHT = LimitSettings.model_validate(
    {"warning": {"high": 0.1}, "critical": {"high": 0.3}, "minimum_count": 2, "duration_s": 0}
)
KINDS = ["good", *["spurious"] * 3, *["good"] * 3, *["spurious"] * 2, "good", "good", "spurious"]


def one_by_one(samples, limits):
    """The severity after each sample, as batches that come one by one are evaluated."""
    window = SampleWindow()
    found = [window.add(each, limits) for each in samples]
    return [each and each.severity for each in found]


@given(
    st.lists(st.integers(0, 4), max_size=40),
    st.integers(1, 5),
    st.sampled_from([0.0, 20.0, 60.0]),
    st.sampled_from([0.0, 0.1]),
)
def test_it_counts_as_many_alarms_as_batches_that_come_one_by_one(drawn, count, duration, hyst):
    limits = LimitSettings.model_validate(
        {
            "watch": {"high": 0.25},
            "critical": {"high": 0.5},
            "minimum_count": count,
            "duration_s": duration,
            "hysteresis": hyst,
        }
    )
    # Eighths have exact sums, so both ways of summing see the same values.
    samples = [(k * 10 * S, part * 2, 8) for k, part in enumerate(drawn)]
    severities = one_by_one(samples, limits)
    began = [
        k for k, each in enumerate(severities) if each and not (k and severities[k - 1] is not None)
    ]
    found = preview_of(samples, limits)
    assert [each.start_ns for each in found.excursions] == [samples[k][0] for k in began]
    assert found.evaluated == max(0, len(samples) - count + 1)
    for each in found.excursions:
        inside = [
            severity
            for (time_ns, _, _), severity in zip(samples, severities, strict=True)
            if each.start_ns <= time_ns and (each.end_ns is None or time_ns < each.end_ns)
        ]
        assert each.severity == max(inside)


def test_values_beyond_are_counted_for_each_severity():
    limits = LimitSettings.model_validate(
        {"warning": {"low": -1, "high": 1}, "critical": {"high": 2}, "minimum_count": 1}
    )
    found = preview_of([(k * S, value, 1) for k, value in enumerate((0, 1.5, 2.5, -3))], limits)
    assert found.beyond == {Severity.WATCH: 0, Severity.WARNING: 3, Severity.CRITICAL: 1}
    off = limits.model_copy(update={"enabled": False})
    assert preview_of([(0, 9.0, 1)], off).beyond[Severity.CRITICAL] == 0


def test_silence_is_previewed_gap_by_gap():
    limits = LimitSettings.model_validate({"warning": {"high": 60}, "minimum_count": 50})
    found = preview_of_gaps([0, 30 * S, 130 * S, 160 * S], limits)
    assert found.evaluated == 3
    (gap,) = found.excursions
    assert (gap.worst, gap.start_ns, gap.end_ns) == (100.0, 130 * S, 160 * S)


def test_it_foretells_the_alarms_that_the_limit_then_raises(opened, make):
    """Batches of one run are previewed; the same batches of another run meet the limit set."""
    app = opened()
    for k, kind in enumerate(KINDS):
        app.submissions.submit(make(f"b{k}", kind=kind, after_s=30.0 * k, run="tried"))
    told = app.part(Alarms).limits.preview("XTE", "unmatched_share", TIGHT, run="tried")
    assert (told.batches, told.is_cut) == (len(KINDS), False)
    app.part(Alarms).limits.set("XTE", "unmatched_share", TIGHT, who="jb")
    app.runs.watch("watched")
    raised = []
    for k, kind in enumerate(KINDS):
        app.submissions.submit(make(f"b{k}", kind=kind, after_s=30.0 * k, run="watched"))
        for alarm in app.part(Alarms).page(run="watched").items:
            if alarm.quantity == "unmatched_share":
                if alarm.raised.time not in [time for time, _ in raised]:
                    raised.append((alarm.raised.time, alarm.raised.bound))
                if alarm.state == "open":
                    app.part(Alarms).acknowledge(alarm.id, "jb")
    assert told.proposed.alarms == len(raised) > 1
    assert [each.start for each in told.proposed.excursions] == [time for time, _ in raised]
    again = app.part(Alarms).limits.preview("XTE", "unmatched_share", TIGHT, run="watched")
    assert again.in_force == again.proposed == told.proposed


def test_a_tracker_is_previewed_by_its_own_values(opened, sky, missions):
    mission = twin(missions)
    app = opened(mission)
    for k in range(8):
        noise = (1.0, 1.0) if k < 4 else (1.0, 9.0)
        app.submissions.submit(
            submission(sky, mission, f"b{k}", after_s=30.0 * k, noise_arcsec=noise)
        )
    tight = LimitSettings.model_validate(
        {"warning": {"high": 2.5}, "minimum_count": 2, "duration_s": 0}
    )
    whole = app.part(Alarms).limits.preview("XTE", "residual_ratio", tight)
    second = app.part(Alarms).limits.preview("XTE", "residual_ratio", tight, tracker=SECOND)
    assert second.tracker == SECOND
    assert second.proposed.alarms == 1
    assert second.proposed.excursions[0].worst > 2.5
    assert whole.proposed != second.proposed
    with pytest.raises(BadInput):
        app.part(Alarms).limits.preview("XTE", "silence_s", tight, tracker=SECOND)


def test_a_run_without_batches_has_a_preview_without_values(opened):
    told = opened().part(Alarms).limits.preview("XTE", "ambiguous_share", TIGHT, run="none")
    assert (told.batches, told.start, told.proposed.evaluated) == (0, None, 0)
