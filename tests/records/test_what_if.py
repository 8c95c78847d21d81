"""What-ifs: the same stars with other options, beside the first result or in its place."""

import json

import pytest
from sqlalchemy import func, select

from service.errors import NotFound
from service.observe.wire import OptionsIn, submission_from_json
from service.records.tables import results
from tests.records.samples import without_accidents

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})


def count(operations):
    with operations.store.reading() as connection:
        return connection.scalar(select(func.count()).select_from(results))


def test_one_that_is_not_kept_answers_and_leaves_nothing(operations, make):
    first = operations.submit(make(kind="suspect"))
    answered = operations.what_if(first.id, TIGHT)
    answer = json.loads(answered.body)
    assert (answered.id, answer["id"]) == (None, None)
    assert (answer["recorded"], answer["parent"]) == (False, first.id)
    assert answer["counts"]["unmatched"] == 1
    assert count(operations) == 1
    assert operations.batch(first.id)["what_ifs"] == []


def test_one_that_is_kept_names_its_parent_and_changes_nothing_else(operations, make):
    first = operations.submit(make(kind="suspect"))
    listed = operations.batches().items
    kept = operations.what_if(first.id, TIGHT, record=True)
    answer = json.loads(kept.body)
    assert (answer["id"], answer["parent"], answer["recorded"]) == (kept.id, first.id, True)
    assert operations.batches().items == listed
    record = operations.batch(kept.id)
    assert (record["current"], record["parent"], record["answer"]) == (False, first.id, answer)
    (shown,) = operations.batch(first.id)["what_ifs"]
    assert (shown["id"], shown["current"]) == (kept.id, False)
    assert shown["options"] == {
        "identifier": "starid",
        "tolerances": {"separation_deg": 1e-5},
    }


def test_one_that_is_adopted_is_what_everything_shows_and_both_are_kept(operations, make):
    first = operations.submit(make(kind="suspect"))
    adopted = operations.what_if(first.id, TIGHT, adopt=True)
    assert [item["id"] for item in operations.batches().items] == [adopted.id]
    assert [item["id"] for item in operations.attitudes("XTE").items] == [adopted.id]
    assert operations.spacecraft_state("XTE")["state"] == "good"
    assert operations.batch(adopted.id)["current"]
    assert not operations.batch(first.id)["current"]
    assert operations.batch(first.id)["answer"] == json.loads(first.body)


def test_of_several_adopted_the_last_is_current(operations, make):
    first = operations.submit(make())
    adopted = [operations.what_if(first.id, TIGHT, adopt=True).id for _ in range(3)]
    current = [id for id in (first.id, *adopted) if operations.batch(id)["current"]]
    assert current == adopted[-1:]


def test_options_replace_what_they_name_and_nothing_else(operations, make):
    body = json.loads(make().text)
    body["options"] = {
        "solver": "triad",
        "tolerances": {"magnitude_mag": 0.5},
        "zone_grid_deg": 0.0,
    }
    first = operations.submit(submission_from_json(json.dumps(body)))
    second = operations.what_if(first.id, TIGHT, record=True)
    wanted = {
        "identifier": "starid",
        "solver": "triad",
        "tolerances": {"magnitude_mag": 0.5, "separation_deg": 1e-5},
        "zone_grid_deg": 0.0,
    }
    assert operations.batch(first.id)["what_ifs"][0]["options"] == wanted
    # A what-if of a what-if begins from the options of the result that it names.
    third = operations.what_if(second.id, OptionsIn(solver="quest"), record=True)
    assert operations.batch(first.id)["what_ifs"][1]["options"] == wanted | {"solver": "quest"}
    assert operations.batch(third.id)["parent"] == second.id


def test_the_same_options_give_the_same_result(operations, make):
    first = operations.submit(make(kind="spurious"))
    again = json.loads(operations.what_if(first.id, OptionsIn()).body)
    del again["parent"], again["recorded"]
    assert without_accidents(again) == without_accidents(json.loads(first.body))


def test_what_cannot_be_done_is_refused_and_leaves_nothing(operations, make):
    operations.submit(make())
    with pytest.raises(NotFound):
        operations.what_if("0" * 26, TIGHT)
    assert count(operations) == 1


def test_a_record_says_what_it_was_asked_to_do_otherwise(operations, make):
    first = operations.submit(make())
    second = operations.what_if(first.id, TIGHT, record=True)
    assert operations.batch(first.id)["options"] == {}
    assert operations.batch(second.id)["options"] == {
        "identifier": "starid",
        "tolerances": {"separation_deg": 1e-5},
    }
