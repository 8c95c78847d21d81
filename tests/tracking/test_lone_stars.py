"""Batches of one or two stars: identified by the prediction, and directions for the filter."""

import copy
import json
import tracemalloc

import numpy as np
import pytest

from service.acquire import acquire
from service.acquire.result import Path
from service.features.definitive.inputs import recorded_in
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json
from service.simulate.motion import turned_by
from service.times import parse_utc, shifted
from service.vectors import quaternion_from_matrix, separation_deg
from tests.chance import at_least, at_most
from tests.scale import size
from tests.storage.bulk import put, result_row
from tests.tracking.conftest import send
from tests.tracking.passes import fly

BATCHES = 10_000
DAY = (parse_utc("1997-01-15T00:00:00Z"), parse_utc("1997-01-16T00:00:00Z"))


def predicted(flown, rng, sigma_arcsec, stars=1):
    """The batch with only some of its stars, and a prediction that is off by its sigma."""
    body = copy.deepcopy(flown.body)
    kept = sorted(rng.permutation(len(flown.stars[0]))[:stars].tolist())
    seen = body["observations"][0]["stars"]
    body["observations"][0]["stars"] = [seen[k] for k in kept]
    off_rad = np.radians(rng.normal(0.0, sigma_arcsec / 3600.0, 3))
    attitude = turned_by(flown.attitude, off_rad)
    body["a_priori"] = {
        "from": "last",
        "prediction": {
            "quaternion": quaternion_from_matrix(attitude).tolist(),
            "covariance_arcsec2": (np.eye(3) * sigma_arcsec**2).tolist(),
            "margin_deg": max(0.01, 3.0 * sigma_arcsec / 3600.0),
        },
    }
    return body, [flown.stars[0][k] for k in kept]


def found(body, sky, mission):
    return acquire(submission_from_json(json.dumps(body)).batch, mission, sky)


def named(acquisition):
    """The unique stars of an acquisition, None for others."""
    rows = acquisition.trackers[0].identification.star.tolist()
    return [None if row < 0 else acquisition.run_catalog.star_id[row] for row in rows]


@pytest.mark.parametrize(("sigma_arcsec", "least"), [(30.0, 0.95), (300.0, 0.6), (3600.0, 0.0)])
def test_a_star_alone_is_named_where_the_prediction_tells_it_and_never_wrongly(
    sky, seed, figures, sigma_arcsec, least
):
    mission = load_missions()["XTE"]
    rng = np.random.default_rng(seed)
    batches, right, wrong = size(BATCHES, 60), 0, 0
    for each in fly(mission, sky, batches, seed):
        body, true = predicted(each, rng, sigma_arcsec)
        (name,) = named(found(body, sky, mission))
        right += name is not None and name == true[0]
        wrong += name is not None and name != true[0]
    figures(batches=batches, right=right, wrong=wrong, prediction_arcsec=sigma_arcsec)
    # 0.999 is asked of each.
    assert wrong <= at_most(batches, 0.001)
    assert right >= at_least(batches, least)


def test_a_star_that_is_none_of_the_catalog_is_not_named(sky):
    mission = load_missions()["XTE"]
    rng = np.random.default_rng(4)
    for each in fly(mission, sky, 50, 4):
        body, _ = predicted(each, rng, 30.0)
        (star,) = body["observations"][0]["stars"]
        h_deg, v_deg = rng.uniform(-2.0, 2.0, 2)
        body["observations"][0]["stars"] = [
            {"h_deg": h_deg, "v_deg": v_deg, "magnitude": star["magnitude"]}
        ]
        acquisition = found(body, sky, mission)
        if named(acquisition) != [None]:
            (row,) = acquisition.trackers[0].identification.star.tolist()
            seen = acquisition.trackers[0].corrected.direction_body[0]
            there = each.attitude @ acquisition.run_catalog.direction[row]
            assert separation_deg(seen, there) < 300.0 / 3600.0


def test_two_stars_that_the_prediction_names_give_an_attitude(sky):
    mission = load_missions()["XTE"]
    rng = np.random.default_rng(5)
    solved = 0
    for each in fly(mission, sky, 40, 5):
        body, true = predicted(each, rng, 30.0, stars=2)
        acquisition = found(body, sky, mission)
        assert all(
            name in (None, right) for name, right in zip(named(acquisition), true, strict=True)
        )
        assert acquisition.path is Path.ZONE
        solved += acquisition.solution is not None
    assert solved >= 36


def test_a_batch_that_tells_nothing_of_its_attitude_names_no_star_alone(sky):
    mission = load_missions()["XTE"]
    (each,) = fly(mission, sky, 1, 6)
    body, _ = predicted(each, np.random.default_rng(6), 30.0)
    body["a_priori"] = {"quaternion": quaternion_from_matrix(each.attitude).tolist()}
    assert named(found(body, sky, mission)) == [None]


def test_a_batch_without_an_attitude_is_tracked_where_a_star_of_it_is_identified(sky):
    mission = load_missions()["XTE"]
    rng = np.random.default_rng(8)
    for sigma_arcsec, is_named in ((30.0, True), (3600.0, False)):
        states = set()
        for each in fly(mission, sky, 10, 8):
            acquisition = found(predicted(each, rng, sigma_arcsec)[0], sky, mission)
            assert acquisition.solution is None
            if (named(acquisition) != [None]) == is_named:
                states.add(acquisition.tracking_state)
        assert states == {"tracking" if is_named else "lost"}


def test_recorded_stars_alone_become_directions_of_the_filter(app, sky):
    mission = app.context.missions["XTE"]
    flown = list(fly(mission, sky, 14, 7, cadence_s=10.0))
    for k, each in enumerate(flown):
        body = copy.deepcopy(each.body)
        if k >= 8:
            body["observations"][0]["stars"] = body["observations"][0]["stars"][:1]
        send(app, body)
    with app.context.reading() as connection:
        recorded = recorded_in(connection, app.context.sky, "XTE", "live", *DAY)
    assert len(recorded.attitudes.tai_ns) == 8
    directions = recorded.directions
    assert len(directions.tai_ns) >= 3
    times = {parse_utc(each.body["time"]).tai_ns: each.attitude for each in flown}
    for tai_ns, body, inertial, sigma in zip(
        directions.tai_ns.tolist(),
        directions.body,
        directions.inertial,
        directions.sigma_rad,
        strict=True,
    ):
        # Observed and apparent directions agree through the true attitude, to the star's noise.
        off_rad = np.linalg.norm(body - times[tai_ns] @ inertial)
        assert off_rad < 5.0 * sigma


def test_long_inputs_are_not_in_memory_all_at_once(app, sky):
    """1,000 batches of 32 kB: whatever the period holds, a part of it is read at a time."""
    (each,) = fly(app.context.missions["XTE"], sky, 1, 7)
    # As JSON may be, with spaces: it is the length that counts.
    text = json.dumps(each.body) + " " * 32_768
    none = {"status": None, "reason": "fewer_than_two_unique_stars", "unique": 1}
    rows = [result_row(app, shifted(DAY[0], 10.0 * k), **none) for k in range(1000)]
    put(app, [(batch | {"input": text}, result) for batch, result in rows])
    with app.context.reading() as connection:
        # The run catalog is built for the first one.
        recorded_in(connection, app.context.sky, "XTE", "live", DAY[0], shifted(DAY[0], 1.0))
        tracemalloc.start()
        try:
            recorded = recorded_in(connection, app.context.sky, "XTE", "live", *DAY)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert len(recorded.directions.tai_ns) == 0
    assert peak < 0.4 * len(rows) * len(text)
