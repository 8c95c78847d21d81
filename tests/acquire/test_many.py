"""Many batches through the compiled loops: the answers of one by one, however they are grouped."""

import copy
import gc
import json

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.acquire import BatchColumns, acquire, acquire_many, acquired
from service.acquire.zone_search import ZoneSearch
from service.errors import AcquisitionError, BadInput
from service.missions.mission import Mission
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache, NotAtHand
from service.sky.model import SkyModel
from service.storage.recording.answer import answer_of
from tests.reference import batches
from tests.reference.compare import Judge

KINDS = ("XTE", "SOHO", "TWO")
"""A cap, a band, and a cap of two trackers that look apart."""
EACH = 24


def file_of(name, mission_files):
    if name != "TWO":
        return mission_files[name]
    file = copy.deepcopy(mission_files["XTE"])
    (tracker,) = file["trackers"]
    # About the boresight, so that both see the same part of the sky.
    x, y = (np.array(tracker[f"{axis}_axis_body"], float) for axis in "xy")
    turned = {"name": "second", "x_axis_body": y.tolist(), "y_axis_body": (-x).tolist()}
    return {**file, "trackers": [tracker, tracker | turned]}


def bodies_of(file, sky):
    """Batches of many kinds: every prior, few stars and many, false ones, two groups, errors."""
    rng = np.random.default_rng(11)
    judge = Judge(file, sky)
    options = ({}, {"identifier": "starid"}, {"solver": "triad"}, {"zone_grid_deg": 0.0})
    found = []
    for number in range(EACH):
        attitude = batches.prior_attitudes(rng, file, 3)[number % 3]
        time = batches.TIMES[number % len(batches.TIMES)]
        body = batches.draw_batch(
            *(rng, file, judge.catalog(time), attitude, number), time=time, magnitude_noise=0.1
        )
        found.append(body | {"options": options[number % 4]})
    twice = copy.deepcopy(next(body for body in found if len(seen_in(body)) >= 4))
    seen_in(twice).extend(
        star | ({"h_deg": star["h_deg"] + 0.4} if "h_deg" in star else {})
        for star in copy.deepcopy(seen_in(twice))
    )
    unknown = copy.deepcopy(found[0])
    unknown["observations"][0]["tracker"] = "nobody's"
    groups = {"options": {"identifier": "starid", "tests": {"match_groups": True}}}
    return [*found, twice, unknown, found[1] | groups, found[2] | {"a_priori": None}]


def seen_in(body):
    return body["observations"][0]["stars"]


def plain(found):
    """An answer without what tells of the moment: how long it took, and what was cached."""
    if isinstance(found, Exception):
        return type(found).__name__, str(found)
    answer = msgspec.to_builtins(answer_of(found, id=None))
    del answer["timings_us"]
    for each in answer["observations"]:
        each["zone"] and each["zone"].pop("cached")
    return json.dumps(answer)


def one_by_one(batch, mission, sky):
    try:
        return plain(acquire(batch, mission, sky))
    except AcquisitionError as error:
        return plain(error)


@pytest.fixture(scope="module")
def cases(mission_files, sky):
    """By kind of mission: the mission, batches, and the answer of each by itself."""
    found = {}
    for name in KINDS:
        file = file_of(name, mission_files)
        mission = Mission.model_validate(file)
        several = [submission_from_json(json.dumps(each)).batch for each in bodies_of(file, sky)]
        found[name] = mission, several, [one_by_one(each, mission, sky) for each in several]
    return found


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
@pytest.mark.parametrize("name", KINDS)
def test_neither_order_nor_grouping_shows_in_an_answer(name, cases, sky, data):
    """Bit for bit: what is compared is the text of every number."""
    mission, several, alone = cases[name]
    rows = data.draw(st.lists(st.integers(0, len(several) - 1), min_size=2, max_size=30))
    found = acquired([several[row] for row in rows], mission, sky)
    assert [plain(each) for each in found] == [alone[row] for row in rows]


@pytest.mark.parametrize("name", KINDS)
def test_batches_with_a_zone_are_finished_by_the_loops(name, cases, sky):
    mission, several, _ = cases[name]
    columns = acquire_many(BatchColumns.of(several[:EACH]), mission, sky)
    assert len(columns.finished) <= 2 * EACH // 3
    # What the loops wrote is there without an answer being made of it.
    solved = [row for row in range(EACH) if row not in columns.finished]
    for row in solved:
        solution = columns.acquisition(row).solution
        assert (columns.zones.fits.matched[row] >= 2) == (solution is not None)


def test_a_faulty_row_names_its_place_and_spoils_no_other(cases, sky):
    mission, several, alone = cases["XTE"]
    faulty = len(several) - 3
    columns = acquire_many(BatchColumns.of(several), mission, sky)
    with pytest.raises(BadInput, match=r"observations\.0\.tracker"):
        columns.acquisition(faulty)
    assert plain(columns.acquisition(0)) == alone[0]


def test_rows_that_would_take_long_are_not_at_hand_and_others_are(cases, sky):
    """No zone is built for who must not wait; in the cache there is that of one batch alone."""
    mission, several, alone = cases["XTE"]
    fresh = SkyModel(sky.catalog, LruCache(64 << 20))
    several = several[:EACH:4]
    found = acquired(several, mission, fresh, at_once=True)
    assert all(isinstance(each, NotAtHand) for each in found)
    acquire(several[0], mission, fresh)
    misses = fresh.cache.state().misses
    first, *_ = found = acquired(several, mission, fresh, at_once=True)
    assert fresh.cache.state().misses == misses
    assert plain(first) == alone[0]
    assert any(isinstance(each, NotAtHand) for each in found)


def test_no_batches_have_no_rows(cases, sky):
    mission, _, _ = cases["XTE"]
    assert acquired([], mission, sky) == []


def zone_searches() -> dict[int, ZoneSearch]:
    """Those that this process holds, by their `id`: other tests may hold some."""
    return {id(each): each for each in gc.get_objects() if type(each) is ZoneSearch}


def test_what_keeps_a_row_from_a_result_is_freed_at_once(cases, sky):
    """An error's traceback would hold the columns that hold the error."""
    mission, several, _ = cases["XTE"]
    fresh = SkyModel(sky.catalog, LruCache(64 << 20))
    gc.collect()
    gc.disable()
    others = zone_searches()
    try:
        found = [acquired([each], mission, fresh, at_once=True)[0] for each in several]
        assert all(isinstance(each, BadInput | NotAtHand) for each in found)
        assert not zone_searches().keys() - others.keys()
    finally:
        gc.enable()
