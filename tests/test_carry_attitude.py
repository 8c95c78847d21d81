"""A replay that carries attitudes: the stored input explains the stored answer."""

import json
from dataclasses import replace

import numpy as np
import pytest

from service.app.factory import open_app
from service.observations.schema import submission_from_json
from service.replay.in_process import replay_in_process
from service.replay.items import AttitudeCarrier, LineOutcome, items_of, turned
from service.replay.over_http import replay_over_http
from service.replay.summary import ReplaySummary
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass, read_objects
from service.vectors import attitude_error_arcsec, matrix_from_quaternion, quaternion_from_matrix
from service.web.app import create_app
from tests.web.serving import Server


@pytest.fixture(scope="module")
def passing(missions, sky):
    """A short pass of an XTE without any prior, ten seconds from batch to batch."""
    drawn = list(draw_pass(missions["XTE"], sky, Pass(5, 5)))
    return [{**each.batch, "a_priori": None} for each in drawn], [each.truth for each in drawn]


def written(path, lines):
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8")
    return path


def carried(path, run, results, send):
    with ReplaySummary([path], results, progress=False) as summary:
        send(items_of([path], run), summary.add)
    return list(read_objects(results))


def test_each_answer_is_the_next_ones_prior_on_both_ways(passing, tmp_path):
    lines, truths = passing
    path = written(tmp_path / "pass.ndjson", lines)
    app = open_app(Settings(database=f"sqlite:///{tmp_path / 'a.db'}"))
    here = carried(
        path,
        "here",
        tmp_path / "here.ndjson",
        lambda items, report: replay_in_process(app, items, report, carrier=AttitudeCarrier()),
    )
    with Server(create_app(app)) as address:
        there = carried(
            path,
            "there",
            tmp_path / "there.ndjson",
            lambda items, report: replay_over_http(
                address, items, report, carrier=AttitudeCarrier()
            ),
        )
        assert [each["path"] for each in here] == ["lost_in_space", *["zone"] * (len(lines) - 1)]
        for one, other in zip(here, there, strict=True):
            assert one["attitude"]["quaternion"] == other["attitude"]["quaternion"]
            assert (
                app.results.get(one["id"]).input["a_priori"]
                == (app.results.get(other["id"]).input["a_priori"])
            )
        stored = [app.results.get(each["id"]).input for each in here]
    assert stored[0]["a_priori"] is None
    for k in range(1, len(lines)):
        prior = matrix_from_quaternion(stored[k]["a_priori"]["quaternion"])
        truth = matrix_from_quaternion(truths[k]["quaternion"])
        assert np.linalg.norm(attitude_error_arcsec(prior, truth)) < 2.0 * 3600


def test_a_second_replay_sends_the_same_and_adds_nothing(passing, tmp_path):
    path = written(tmp_path / "pass.ndjson", passing[0])
    app = open_app(Settings(database=f"sqlite:///{tmp_path / 'a.db'}"))
    try:
        for attempt in range(2):
            with ReplaySummary([path], None, progress=False) as summary:
                replay_in_process(
                    app, items_of([path], "twice"), summary.add, carrier=AttitudeCarrier()
                )
            expected = (0, len(passing[0])) if attempt else (len(passing[0]), 0)
            assert (summary.new, summary.replayed) == expected
            assert summary.refused == 0
    finally:
        app.close()


def answered(item, quaternion, status="good"):
    attitude = None if status is None else {"quaternion": quaternion, "status": status}
    return LineOutcome(item, json.dumps({"attitude": attitude}).encode())


@pytest.fixture
def items(passing, tmp_path):
    rates = [0.1, -0.05, 0.02]
    lines = [{**line, "body_rates_deg_per_s": rates} for line in passing[0]]
    return list(items_of([written(tmp_path / "rates.ndjson", lines)], "run"))


def prior_of(item):
    prior = json.loads(item.submission.text).get("a_priori")
    return None if prior is None else prior["quaternion"]


def test_the_attitude_turns_with_the_body_rates_on_the_way(items):
    carrier = AttitudeCarrier()
    start = quaternion_from_matrix(matrix_from_quaternion([0.5, 0.5, 0.5, 0.5])).tolist()
    carrier.note(answered(items[0], start))
    first, second = items[0].submission.batch, items[1].submission.batch
    passed_s = (second.time.tai_ns - first.time.tai_ns) * 1e-9
    prior = prior_of(carrier.prepared(items[1]))
    # A star that stood still is where the small turn puts it: db/dt = -w x b.
    steps = 20_000
    b = matrix_from_quaternion(start) @ np.array([0.3, 0.4, 0.866])
    w = np.radians([0.1, -0.05, 0.02])
    for _ in range(steps):
        b = b - np.cross(w, b) * (passed_s / steps)
    assert matrix_from_quaternion(prior) @ np.array([0.3, 0.4, 0.866]) == pytest.approx(b, abs=1e-4)


@pytest.mark.parametrize("status", ["suspect", None])
def test_only_good_attitudes_are_carried(items, status):
    carrier = AttitudeCarrier()
    carrier.note(answered(items[0], [0.0, 0.0, 0.0, 1.0], status))
    assert carrier.prepared(items[1]) is items[1]


def test_the_last_good_one_outlives_a_bad_one(items):
    carrier = AttitudeCarrier()
    carrier.note(answered(items[0], [0.0, 0.0, 0.0, 1.0]))
    carrier.note(answered(items[1], [1.0, 0.0, 0.0, 0.0], "suspect"))
    first, third = items[0].submission.batch, items[2].submission.batch
    passed_s = (third.time.tai_ns - first.time.tai_ns) * 1e-9
    expected = turned(np.eye(3), np.array([0.1, -0.05, 0.02]), passed_s)
    prior = matrix_from_quaternion(prior_of(carrier.prepared(items[2])))
    assert prior == pytest.approx(expected, abs=1e-9)


def test_a_refused_line_and_another_spacecraft_carry_nothing(items):
    carrier = AttitudeCarrier()
    carrier.note(answered(items[0], [0.0, 0.0, 0.0, 1.0]))
    refused = replace(items[1], submission=None, problem={"detail": "no"})
    assert carrier.prepared(refused) is refused
    body = json.loads(items[1].submission.text) | {"spacecraft": "SWAS"}
    other = replace(items[1], submission=submission_from_json(json.dumps(body)))
    assert carrier.prepared(other) is other


def test_after_an_hour_a_batch_keeps_what_it_came_with(items):
    carrier = AttitudeCarrier()
    carrier.note(answered(items[0], [0.0, 0.0, 0.0, 1.0]))
    body = json.loads(items[1].submission.text) | {"time": "2031-01-01T00:00:00Z"}
    later = replace(items[1], submission=submission_from_json(json.dumps(body)))
    assert carrier.prepared(later) is later
