"""What-ifs: the same stars with other options, beside the first result or in its place."""

import json

import pytest
from msgspec import to_builtins
from sqlalchemy import func, select

from service.errors import NotFound
from service.observations.schema import OptionsIn, submission_from_json
from service.storage.sql.tables import results
from tests.storage.samples import without_accidents

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})


def count(app):
    with app.store.reading() as connection:
        return connection.scalar(select(func.count()).select_from(results))


def test_one_that_is_not_kept_answers_and_leaves_nothing(app, make):
    first = app.submissions.submit(make(kind="suspect"))
    answered = app.results.what_if(first.id, TIGHT)
    answer = json.loads(answered.body)
    assert (answered.id, answer["id"]) == (None, None)
    assert (answer["recorded"], answer["parent"]) == (False, first.id)
    assert answer["counts"]["unmatched"] == 1
    assert count(app) == 1
    assert app.results.get(first.id).what_ifs == []


@pytest.mark.both_databases
def test_one_that_is_kept_names_its_parent_and_changes_nothing_else(app, make):
    first = app.submissions.submit(make(kind="suspect"))
    listed = app.results.page().items
    kept = app.results.what_if(first.id, TIGHT, record=True)
    answer = json.loads(kept.body)
    assert (answer["id"], answer["parent"], answer["recorded"]) == (kept.id, first.id, True)
    assert app.results.page().items == listed
    record = app.results.get(kept.id)
    assert (record.current, record.parent, to_builtins(record.answer)) == (False, first.id, answer)
    (shown,) = app.results.get(first.id).what_ifs
    assert (shown.id, shown.current) == (kept.id, False)
    assert shown.options == {
        "identifier": "starid",
        "tolerances": {"separation_deg": 1e-5},
    }


def test_one_that_is_adopted_is_what_everything_shows_and_both_are_kept(app, make):
    first = app.submissions.submit(make(kind="suspect"))
    adopted = app.results.what_if(first.id, TIGHT, adopt=True)
    assert [item.id for item in app.results.page().items] == [adopted.id]
    assert [item.id for item in app.spacecraft.attitudes("XTE").items] == [adopted.id]
    assert app.spacecraft.state("XTE").state == "good"
    assert app.results.get(adopted.id).current
    assert not app.results.get(first.id).current
    assert to_builtins(app.results.get(first.id).answer) == json.loads(first.body)


@pytest.mark.both_databases
def test_of_several_adopted_the_last_is_current(app, make):
    first = app.submissions.submit(make())
    adopted = [app.results.what_if(first.id, TIGHT, adopt=True).id for _ in range(3)]
    current = [id for id in (first.id, *adopted) if app.results.get(id).current]
    assert current == adopted[-1:]


def test_options_replace_what_they_name_and_nothing_else(app, make):
    body = json.loads(make().text)
    body["options"] = {
        "solver": "triad",
        "tolerances": {"magnitude_mag": 0.5},
        "zone_grid_deg": 0.0,
    }
    first = app.submissions.submit(submission_from_json(json.dumps(body)))
    second = app.results.what_if(first.id, TIGHT, record=True)
    wanted = {
        "identifier": "starid",
        "solver": "triad",
        "tolerances": {"magnitude_mag": 0.5, "separation_deg": 1e-5},
        "zone_grid_deg": 0.0,
    }
    assert app.results.get(first.id).what_ifs[0].options == wanted
    # A what-if of a what-if begins from the options of the result that it names.
    third = app.results.what_if(second.id, OptionsIn(solver="quest"), record=True)
    assert app.results.get(first.id).what_ifs[1].options == wanted | {"solver": "quest"}
    assert app.results.get(third.id).parent == second.id


def test_the_same_options_give_the_same_result(app, make):
    first = app.submissions.submit(make(kind="spurious"))
    again = json.loads(app.results.what_if(first.id, OptionsIn()).body)
    del again["parent"], again["recorded"]
    assert without_accidents(again) == without_accidents(json.loads(first.body))


def test_what_cannot_be_done_is_refused_and_leaves_nothing(app, make):
    app.submissions.submit(make())
    with pytest.raises(NotFound):
        app.results.what_if("0" * 26, TIGHT)
    assert count(app) == 1


def test_a_record_says_what_it_was_asked_to_do_otherwise(app, make):
    first = app.submissions.submit(make())
    second = app.results.what_if(first.id, TIGHT, record=True)
    assert app.results.get(first.id).options == {}
    assert app.results.get(second.id).options == {
        "identifier": "starid",
        "tolerances": {"separation_deg": 1e-5},
    }
