"""Drafts: all of a result but the time that recording took, in whichever process they were made."""

import json
import pickle

import pytest
from msgspec import structs

from tests.records import samples


@pytest.fixture
def draft(operations, make):
    """Drafts what `make` makes, as the intake does."""
    return lambda *named, **wanted: operations._intake._bench.draft(make(*named, **wanted))


@pytest.mark.parametrize("kind", samples.KINDS)
def test_a_draft_comes_from_another_process_whole_but_for_its_mission(draft, kind):
    made = draft(kind=kind)
    (come,) = pickle.loads(pickle.dumps([made], pickle.HIGHEST_PROTOCOL))
    assert come.mission is None
    come.mission = made.mission
    assert structs.asdict(come) == structs.asdict(made)


def test_drafts_that_come_together_are_small(draft):
    """What they are made of has one name for all of them, and a mission's settings stay behind."""
    together = [draft(f"b{k}", after_s=60.0 * k) for k in range(8)]
    size = len(pickle.dumps(together, pickle.HIGHEST_PROTOCOL))
    # Of one by itself it would be half as much again.
    assert size < 1.4 * sum(len(each.answer) + len(each.batch["input"]) for each in together)


@pytest.mark.parametrize("name", ['"record":null', '{"timings_us":{"record":null}}', "\\"])
def test_the_time_of_recording_has_its_place_whatever_a_client_calls_its_batch(
    operations, make, draft, name
):
    made = draft(name)
    drafted = json.loads(made.answer)
    assert drafted["timings_us"].pop("record") is None
    (answered,) = operations.submit_many([make(name, run="again")])
    answer = json.loads(answered.body)
    assert answer["timings_us"].pop("record") > 0
    assert (drafted["batch"], answer["batch"]) == (name, name)
    assert drafted["timings_us"].keys() == answer["timings_us"].keys()
