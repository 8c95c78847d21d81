"""Nominal telemetry of the shipped missions looks nominal: no alarm, no line to change."""

import json
from contextlib import closing

import pytest

from service.app.factory import open_app
from service.features.advice.part import AdviceService
from service.features.alarms.part import Alarms
from service.missions.mission import load_missions
from service.replay.in_process import replay_in_process
from service.replay.items import items_of
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from tests.fresh_databases import sqlite_at
from tests.web.serving import in_process_settings

DAY_S = 86_400
CADENCE_S = 300
"""Five times rarer than the shipped demonstration, so that a day takes seconds."""
RUN = "day"


@pytest.mark.parametrize("name", sorted(load_missions()))
def test_a_nominal_day_raises_no_alarm_and_no_advice(name, tmp_path, sky, seed):
    mission = load_missions()[name]
    wanted = Pass(DAY_S // CADENCE_S, seed, cadence_s=CADENCE_S, troubles=NO_TROUBLES)
    file = tmp_path / "day.ndjson"
    with file.open("w") as lines:
        lines.writelines(f"{json.dumps(each.batch)}\n" for each in draw_pass(mission, sky, wanted))
    refused = []
    with closing(open_app(in_process_settings(sqlite_at(tmp_path / "day.db")))) as app:
        app.service.ready()
        app.runs.watch(RUN)
        replay_in_process(
            app,
            items_of([file], RUN),
            lambda outcome: refused.append(outcome.problem) if outcome.problem else None,
        )
        alarms = app.part(Alarms).page(run=RUN, state="all").items
        advice = app.part(AdviceService).of_spacecraft(name, run=RUN, sample=100)
    assert refused == []
    assert [(each.quantity, each.value) for each in alarms] == []
    assert [each.line for each in advice.changes] == []
