"""Who was first: one body, one record, one answer."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import create_engine, delete, func, select
from sqlalchemy.exc import IntegrityError

from service.access import Caller
from service.errors import BadBatch, BadInput, Conflict, KeyReused
from service.observations.schema import OptionsIn, submission_from_json
from service.storage.sql.columns import metadata
from service.storage.sql.statements import COPIED_FROM
from service.storage.sql.tables import batches, idempotency_keys, results, solutions, star_results
from tests.storage.recount import assert_equal_to_a_recount

pytestmark = pytest.mark.both_databases

REPEATS = 50


def count(app, table):
    with app.store.reading() as connection:
        return connection.scalar(select(func.count()).select_from(table))


MADE_LATER = ("record_facts", "record_heads")
"""The chain of the record follows it in its own time."""


def everything(app):
    with app.store.reading() as connection:
        return {
            table.name: sorted(map(tuple, connection.execute(select(table))), key=repr)
            for table in metadata.sorted_tables
            if table.name not in MADE_LATER
        }


def outcome_of(function, *arguments):
    try:
        return function(*arguments)
    except Exception as error:
        return error


def all_at_once(app, sent):
    """Submit from one thread each, all let go at the same moment."""
    gate = threading.Barrier(len(sent))

    def submit(each):
        gate.wait()
        return outcome_of(app.submissions.submit, *each)

    with ThreadPoolExecutor(len(sent)) as threads:
        return list(threads.map(submit, sent))


def test_the_same_body_gets_the_stored_answer_byte_for_byte(app, make):
    first = app.submissions.submit(make())
    again = app.submissions.submit(make())
    assert not first.replayed
    assert again.replayed
    assert (again.id, again.body) == (first.id, first.body)
    assert count(app, batches) == 1


def caller(id):
    return Caller(f"name of {id}", frozenset(["submit"]), None, id)


def test_a_key_of_one_token_is_not_that_of_another(app, make):
    """Nor of nobody's: other bodies go under the same key, and each keeps its own."""
    callers = caller("A"), caller("B"), None
    sent = [make(name, after_s=60.0 * k) for k, name in enumerate("abc")]
    firsts = [
        app.submissions.submit(each, "key", who) for each, who in zip(sent, callers, strict=True)
    ]
    assert len({first.id for first in firsts}) == 3
    assert not any(first.replayed for first in firsts)
    for k, (first, each, who) in enumerate(zip(firsts, sent, callers, strict=True)):
        again = app.submissions.submit(each, "key", who)
        assert (again.replayed, again.id) == (True, first.id)
        with pytest.raises(KeyReused, match="'key'"):
            app.submissions.submit(sent[k - 1], "key", who)
    assert count(app, idempotency_keys) == 3


def test_keys_of_several_tokens_at_once_and_of_a_repeat_are_kept_apart(app, make):
    """The same body under the same key of two tokens is one record, and each has the key."""
    sent = make()
    answers = all_at_once(app, [(sent, "key", caller(f"T{k}")) for k in range(8)])
    assert len({each.id for each in answers}) == 1
    assert count(app, idempotency_keys) == 8
    other = make(stars=4)
    for k in range(8):
        with pytest.raises(KeyReused):
            app.submissions.submit(other, "key", caller(f"T{k}"))
    with pytest.raises(Conflict):
        app.submissions.submit(other, "key")


def test_white_space_and_the_order_of_keys_make_no_other_body(app, make):
    submission = make()
    first = app.submissions.submit(submission)
    turned = dict(reversed(json.loads(submission.text).items()))
    again = app.submissions.submit(submission_from_json(json.dumps(turned, indent=3)))
    assert again.body == first.body


def test_another_body_under_a_batch_id_that_is_taken_is_a_conflict_and_changes_nothing(app, make):
    app.submissions.submit(make())
    before = everything(app)
    with pytest.raises(Conflict, match="'b1'"):
        app.submissions.submit(make(stars=4))
    assert everything(app) == before


def test_a_batch_id_is_taken_within_its_run_and_spacecraft_only(app, make):
    sent = [make(), make(run="again"), make(spacecraft="SWAS")]
    assert len({app.submissions.submit(each).id for each in sent}) == 3


def test_a_key_with_another_body_is_refused_before_anything_else_is_looked_at(app, make):
    app.submissions.submit(make("b1"), "key")
    app.submissions.submit(make("b2"))
    before = everything(app)
    with pytest.raises(KeyReused, match="'key'"):
        app.submissions.submit(make("b3"), "key")
    with pytest.raises(KeyReused):
        # Both the key and the batch are taken: the key is what is told.
        app.submissions.submit(make("b2", stars=4), "key")
    assert everything(app) == before


def test_a_key_with_the_same_body_gets_the_first_answer_even_after_another_was_adopted(app, make):
    first = app.submissions.submit(make(), "key")
    wider = OptionsIn.model_validate(
        {"identifier": "starid", "tolerances": {"separation_deg": 0.01}}
    )
    app.results.what_if(first.id, wider, record=True, adopt=True)
    assert app.submissions.submit(make(), "key").body == first.body
    assert app.submissions.submit(make()).body == first.body


def test_a_key_that_comes_with_a_repeat_belongs_to_its_body_from_then_on(app, make):
    first = app.submissions.submit(make())
    assert app.submissions.submit(make(), "late").body == first.body
    with pytest.raises(KeyReused):
        app.submissions.submit(make("b2"), "late")


@pytest.mark.parametrize("key", ["", "x" * 256, "a\nb", "clé"])
def test_a_key_that_cannot_be_one_is_named(app, make, key):
    with pytest.raises(BadBatch, match="Idempotency-Key"):
        app.submissions.submit(make(), key)


def test_what_is_refused_leaves_nothing_and_takes_no_identity(app, make):
    submission = make()
    before = everything(app)
    wrong = json.loads(submission.text)
    wrong["observations"][0]["tracker"] = "NO_SUCH"
    with pytest.raises(BadInput, match="NO_SUCH"):
        app.submissions.submit(submission_from_json(json.dumps(wrong)), "key")
    wrong = json.loads(submission.text) | {"spacecraft": "NO_SUCH"}
    with pytest.raises(BadBatch, match="NO_SUCH") as refusal:
        app.submissions.submit(submission_from_json(json.dumps(wrong)), "key")
    (fault,) = refusal.value.faults
    assert (fault.field, fault.value) == ("spacecraft", "'NO_SUCH'")
    assert "SOHO, SWAS, XTE" in fault.message
    assert everything(app) == before
    assert not app.submissions.submit(submission, "key").replayed


def test_fifty_concurrent_repeats_are_computed_and_recorded_once(app, make):
    submission = make()
    answers = all_at_once(app, [(submission, "key")] * REPEATS)
    assert len({(answer.id, answer.body) for answer in answers}) == 1
    assert sum(not answer.replayed for answer in answers) == 1
    assert app.submissions.counts.batches.total() == 1
    assert count(app, results) == 1
    assert count(app, star_results) == 5


def test_of_fifty_concurrent_bodies_under_one_batch_id_one_is_recorded(app, make):
    bodies = [make(stars=2 + index % 4) for index in range(REPEATS)]
    outcomes = all_at_once(app, [(body, None) for body in bodies])
    recorded = [each for each in outcomes if not isinstance(each, Exception)]
    assert len({each.body for each in recorded}) == 1
    assert all(isinstance(each, Conflict) for each in outcomes if isinstance(each, Exception))
    assert len(recorded) in (12, 13)
    assert count(app, results) == 1


def test_of_fifty_concurrent_batches_under_one_key_one_is_recorded(app, make):
    outcomes = all_at_once(app, [(make(f"b{i}"), "key") for i in range(REPEATS)])
    errors = [each for each in outcomes if isinstance(each, Exception)]
    assert len(errors) == REPEATS - 1
    assert all(isinstance(error, KeyReused) for error in errors)
    assert count(app, results) == count(app, idempotency_keys) == 1


def test_what_was_recorded_between_look_and_transaction_is_found(app, make):
    """An unsaved result is new when looked up; one that was recorded since is still noticed."""
    solve = app.submissions.solver.solve
    key = "of another body"
    sent = [make(f"b{i}") for i in range(6)]
    changed = make("b2", after_s=3600.0)
    unsaved_results = [solve(each) for each in (sent[0], sent[1], changed, sent[3])]
    unsaved_results += [solve(sent[4], key=("", key)), solve(sent[5])]
    first = [app.submissions.submit(each) for each in (sent[1], sent[2])]
    app.submissions.submit(make("b6"), key)
    new, repeat, conflict, neighbour, reused, last = app.store.writer.record(unsaved_results)
    assert [each.replayed for each in (new, neighbour, last)] == [False, False, False]
    assert (repeat.id, repeat.body, repeat.replayed) == (first[0].id, first[0].body, True)
    assert isinstance(conflict, Conflict)
    assert isinstance(reused, KeyReused)
    assert count(app, results) == 6
    assert count(app, idempotency_keys) == 1
    with app.store.reading() as connection:
        assert_equal_to_a_recount(connection)


def test_a_repeat_of_what_is_pruned_at_the_same_moment_is_recorded_anew(app, make, monkeypatch):
    store = app.store
    reading = store.reading_record
    first = app.submissions.submit(make("b1"))

    def after_pruning():
        monkeypatch.undo()
        other = create_engine(store.url)
        with other.begin() as connection:
            for table in (solutions, star_results, results, batches):
                connection.execute(delete(table))
        other.dispose()
        return reading()

    monkeypatch.setattr(store, "reading_record", after_pruning)
    again = app.submissions.submit(make("b1"))
    assert (again.replayed, again.id == first.id) == (False, False)
    assert count(app, results) == 1


def test_a_run_whose_making_was_taken_back_is_made_with_the_next_of_its_batches(app, make):
    """Which runs there are is remembered with the connection, whatever became of them."""
    solve = app.submissions.solver.solve
    bad = solve(make("b1", run="another"))
    bad.result["mission_digest"] = "sha256:of nothing that is there"
    (refused,) = app.store.writer.record([bad])
    assert isinstance(refused, IntegrityError)
    assert [each.run for each in app.runs.all()] == []
    assert not app.submissions.submit(make("b2", run="another")).replayed
    assert [each.run for each in app.runs.all()] == ["another"]


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_two_services_on_one_database_record_a_batch_once(opened, make):
    """The unique constraint decides between processes; whoever loses answers with the winner's."""
    services = [opened(), opened()]
    sent = [make(f"b{i}", after_s=60.0 * i) for i in range(40)]

    def submit_all(app):
        return [app.submissions.submit(each).body for each in sent]

    def submit_chunks(app):
        return [
            answer.body
            for first in range(0, len(sent), 8)
            for answer in app.submissions.submit_many(sent[first : first + 8])
        ]

    work = [(submit_all, 0), (submit_all, 1), (submit_chunks, 0), (submit_chunks, 1)]
    with ThreadPoolExecutor(len(work)) as threads:
        bodies = list(threads.map(lambda each: each[0](services[each[1]]), work))
    assert bodies[0] == bodies[1] == bodies[2] == bodies[3]
    assert count(services[0], results) == len(sent)


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_two_services_that_record_the_same_batches_at_once_record_each_once(opened, make):
    """Chunks large enough for COPY on PostgreSQL: the conflict rules are those of inserts."""
    services = [opened(), opened()]
    sent = [make(f"b{i}", after_s=60.0 * i) for i in range(2 * COPIED_FROM)]

    def submit_chunks(app):
        return [
            answer.body
            for first in range(0, len(sent), COPIED_FROM)
            for answer in app.submissions.submit_many(sent[first : first + COPIED_FROM])
        ]

    with ThreadPoolExecutor(2) as threads:
        bodies = list(threads.map(submit_chunks, services))
    assert bodies[0] == bodies[1]
    assert count(services[0], results) == len(sent)
    assert count(services[0], star_results) == sum(
        len(each.batch.observations[0].magnitude_mag) for each in sent
    )
    with services[0].store.reading() as connection:
        assert_equal_to_a_recount(connection)
