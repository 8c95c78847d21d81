"""Unsaved results: all but the time that recording took, in whichever process they were made."""

import json
import pickle

import pytest
from msgspec import structs

from service.ingest.worker_process import MOST_BYTES, PACKED_TOGETHER, packed
from tests.storage import samples


@pytest.fixture
def unsaved(app, make):
    """The unsaved result of what `make` makes."""
    return lambda *named, **wanted: app.submissions.solver.solve(make(*named, **wanted))


@pytest.mark.parametrize("kind", samples.KINDS)
def test_a_draft_comes_from_another_process_whole(unsaved, kind):
    made = unsaved(kind=kind)
    (come,) = pickle.loads(pickle.dumps([made], pickle.HIGHEST_PROTOCOL))
    assert structs.asdict(come) == structs.asdict(made)


def test_drafts_that_come_together_are_small(unsaved):
    """What they are made of has one name for all of them."""
    together = [unsaved(f"b{k}", after_s=60.0 * k) for k in range(2 * PACKED_TOGETHER)]
    packs = packed(together)
    assert [len(pickle.loads(pack)) for pack in packs] == [PACKED_TOGETHER] * 2
    alone = sum(len(pack) for each in together for pack in packed([each]))
    assert sum(map(len, packs)) < 0.95 * alone


def test_what_is_large_comes_alone():
    large = [b"x" * MOST_BYTES, b"y", b"z" * MOST_BYTES]
    packs = packed([*large, *[b"small"] * PACKED_TOGETHER])
    assert [pickle.loads(pack) for pack in packs[:3]] == [[each] for each in large]
    assert [each for pack in packs for each in pickle.loads(pack)] == [
        *large,
        *[b"small"] * PACKED_TOGETHER,
    ]
    assert max(len(pickle.loads(pack)) for pack in packs) > 1


@pytest.mark.parametrize("name", ['"record":null', '{"timings_us":{"record":null}}', "\\"])
def test_the_time_of_recording_has_its_place_whatever_a_client_calls_its_batch(
    app, make, unsaved, name
):
    made = unsaved(name)
    drafted = json.loads(made.answer)
    assert drafted["timings_us"].pop("record") is None
    (answered,) = app.submissions.submit_many([make(name, run="again")])
    answer = json.loads(answered.body)
    assert answer["timings_us"].pop("record") > 0
    assert (drafted["batch"], answer["batch"]) == (name, name)
    assert drafted["timings_us"].keys() == answer["timings_us"].keys()
