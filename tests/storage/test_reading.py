"""Lists, histories and states: what is current, in order, a page at a time."""

import json

import pytest
from msgspec import structs, to_builtins
from sqlalchemy import select
from sqlalchemy.dialects import sqlite

from service.errors import BadBatch, NotFound
from service.missions.mission import SHIPPED_FOLDER
from service.observations.schema import OptionsIn
from service.storage.queries.histories import attitudes
from service.storage.queries.pages import ResultFilter, newest_first
from service.storage.queries.results import summary_query
from service.storage.sql.tables import solutions
from service.times import parse_utc
from tests.storage.samples import KINDS

pytestmark = pytest.mark.both_databases

HOUR = 3600.0


@pytest.fixture
def filled(app, make):
    """Ten live batches an hour apart, sent out of order, two at one moment; two of another run."""
    for index in (3, 1, 4, 0, 5, 9, 2, 6, 8, 7):
        kind = KINDS[index % len(KINDS)]
        app.submissions.submit(make(f"b{index}", kind=kind, after_s=HOUR * min(index, 8)))
    app.submissions.submit(make("b0", run="again"))
    app.submissions.submit(make("c0", spacecraft="SWAS"))
    return app


def walked(page_after):
    """Every item of a list, read page by page."""
    items, cursor = [], None
    while True:
        page = page_after(cursor)
        items += page.items
        cursor = page.next_cursor
        if cursor is None:
            return items


def names(items):
    return [item.batch for item in items]


def test_batches_come_newest_first_by_their_own_time(filled):
    items = filled.results.page(spacecraft="XTE").items
    times = [item.time for item in items]
    assert times == sorted(times, reverse=True)
    assert set(names(items)) == {f"b{index}" for index in range(10)}
    assert {item.run for item in items} == {"live"}


def test_pages_laid_end_to_end_are_the_whole_list(filled):
    whole = filled.results.page(spacecraft="XTE")
    assert whole.next_cursor is None
    for limit in (1, 2, 3, 10):
        pages = walked(
            lambda cursor, limit=limit: filled.results.page(
                spacecraft="XTE", limit=limit, cursor=cursor
            )
        )
        assert pages == whole.items


def test_a_page_is_not_disturbed_by_what_arrives_or_is_adopted_meanwhile(filled, make):
    first = filled.results.page(spacecraft="XTE", limit=4)
    filled.submissions.submit(make("newer", after_s=20 * HOUR))
    filled.results.what_if(first.items[-1].id, OptionsIn(), adopt=True)
    second = filled.results.page(spacecraft="XTE", limit=20, cursor=first.next_cursor)
    assert len(set(names(first.items) + names(second.items))) == 10


def test_filters_choose_by_outcome_status_run_spacecraft_and_time(filled):
    assert len(filled.results.page().items) == 11
    assert names(filled.results.page(spacecraft="SWAS").items) == ["c0"]
    assert names(filled.results.page(run="again").items) == ["b0"]
    suspect = filled.results.page(spacecraft="XTE", status="suspect").items
    assert names(suspect) == ["b9", "b5", "b1"]
    assert {item.status for item in suspect} == {"suspect"}
    none = filled.results.page(spacecraft="XTE", status="none").items
    assert names(none) == ["b6", "b2"]
    assert {item.reason for item in none} == {"fewer_than_two_unique_stars"}
    unmatched = filled.results.page(spacecraft="XTE", outcome="unmatched").items
    assert unmatched
    assert all(item.counts.unmatched for item in unmatched)
    start, end = parse_utc("1996-01-10T13:00:00Z"), parse_utc("1996-01-10T15:00:00Z")
    assert names(filled.results.page(spacecraft="XTE", start=start, end=end).items) == ["b2", "b1"]


@pytest.mark.parametrize(
    "cursor", ["x", "!!", "MTIz", "MTIzLg", "é", "OTk5OTk5OTk5OTk5OTk5OTk5OTk5OS54"]
)
def test_a_cursor_that_no_page_gave_is_named(filled, cursor):
    with pytest.raises(BadBatch, match="cursor"):
        filled.results.page(cursor=cursor)


def test_attitudes_come_oldest_first_and_only_where_there_is_one(filled):
    items = walked(lambda cursor: filled.spacecraft.attitudes("XTE", limit=3, cursor=cursor))
    assert [item.time for item in items] == sorted(item.time for item in items)
    assert set(names(items)) == {f"b{index}" for index in range(10)} - {"b2", "b6"}
    for item in items:
        answer = structs.asdict(filled.results.get(item.id).answer.attitude)
        shown = structs.asdict(item)
        both = answer.keys() & shown.keys()
        assert {key: answer[key] for key in both} == {key: shown[key] for key in both}
        assert both >= {"quaternion", "frame", "covariance_arcsec2", "taste", "status"}


def test_where_there_is_no_attitude_there_is_no_row_of_one(filled):
    with filled.store.reading() as connection:
        ids = set(connection.scalars(select(solutions.c.result_id)))
    for item in filled.results.page(spacecraft="XTE").items:
        assert (item.id in ids) == (item.status is not None)


def test_a_record_holds_the_answer_as_sent_and_the_input_that_made_it(app, make):
    submission = make()
    answered = app.submissions.submit(submission)
    found = app.results.get(answered.id)
    record = to_builtins(found)
    measured, attitude = record.pop("measures"), json.loads(answered.body)["attitude"]
    assert measured["residual_rms_arcsec"] == pytest.approx(
        attitude["residual_rms_arcsec"], abs=5e-4
    )
    assert record == {
        "answer": json.loads(answered.body),
        "input": json.loads(submission.text),
        "options": {},
        "current": True,
        "archived": False,
        "parent": None,
        "what_ifs": [],
    }
    assert found.answer.timings_us.record > 0


@pytest.mark.parametrize("id", ["", "no", "0" * 26, "\0" * 26, "é" * 26])
def test_an_id_that_was_never_given_out_is_not_found(app, id):
    with pytest.raises(NotFound):
        app.results.get(id)
    with pytest.raises(NotFound):
        app.replays.get(id)


def test_a_spacecraft_shows_its_newest_batch_and_its_newest_attitude(app, make):
    assert app.spacecraft.state("XTE").state == "no_batches"
    app.submissions.submit(make("b1", after_s=HOUR))
    app.submissions.submit(make("b0"))
    app.submissions.submit(make("b9", run="again", kind="suspect", after_s=9 * HOUR))
    state = app.spacecraft.state("XTE")
    assert (state.state, state.latest_batch.batch) == ("good", "b1")
    assert state.attitude == state.last_attitude
    app.submissions.submit(make("b2", kind="one_star", after_s=2 * HOUR))
    state = app.spacecraft.state("XTE")
    assert (state.state, state.latest_batch.batch) == ("no_attitude", "b2")
    # The older attitude is shown as what it is: no attitude of now, and with its time.
    assert state.attitude is None
    assert (state.last_attitude.batch, state.last_attitude.time[11:13]) == ("b1", "13")
    listed = {each.name: each.state for each in app.spacecraft.states()}
    assert listed == dict.fromkeys(app.missions, "no_batches") | {"XTE": "no_attitude"}


def test_an_unknown_spacecraft_is_not_found_and_the_known_ones_are_named(app):
    for ask in (app.spacecraft.state, app.spacecraft.attitudes, app.spacecraft.rates):
        with pytest.raises(NotFound, match="SOHO, SWAS, XTE"):
            ask("HST")


def test_settings_that_change_leave_a_history(opened, tmp_path):
    first = opened()
    before = first.missions["XTE"].digest
    first.close()
    shipped = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    (tmp_path / "site").mkdir()
    changed = shipped.replace("radius_deg = 10.66", "radius_deg = 11.0")
    (tmp_path / "site" / "xte.toml").write_text(changed, encoding="utf-8")
    second = opened(missions=tmp_path / "site")
    state = second.spacecraft.state("XTE")
    second.close()
    assert [each.digest for each in state.history] == [before, state.mission.digest]
    assert state.history[1].settings["zone"]["radius_deg"] == 11.0
    assert state.mission.settings == state.history[1].settings
    # Who goes back to what was, and then begins again with it, used it twice and no more.
    for _ in range(2):
        third = opened()
        returned = third.spacecraft.state("XTE").history
        third.close()
    assert [each.digest for each in returned] == [before, state.mission.digest, before]


def test_runs_show_what_they_hold(filled):
    again, live = filled.runs.all()
    assert (again.run, again.batches, again.spacecraft) == ("again", 1, ["XTE"])
    assert (live.run, live.batches, live.spacecraft) == ("live", 11, ["SWAS", "XTE"])
    assert (live.first_day, live.last_day) == ("1996-01-10", "1996-01-10")


def test_lists_histories_and_trends_are_read_from_an_index(app):
    """A page is found in the index and costs the rows it shows, however many there are."""
    if app.store.url.drivername != "sqlite":
        pytest.skip("PostgreSQL plans by statistics; the indexes are the same")
    for query, index in (
        (summary_query().where(*ResultFilter("live", "XTE").conditions()), "by_spacecraft"),
        (summary_query().where(*ResultFilter("live").conditions()), "by_run"),
        (attitudes().where(*ResultFilter("live", "XTE").conditions()), "by_spacecraft"),
    ):
        ordered = newest_first(query).limit(100)
        sql = str(ordered.compile(dialect=sqlite.dialect(), compile_kwargs={"literal_binds": True}))
        with app.store.reading() as connection:
            plan = str(connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {sql}").all())
        assert f"ix_results_current_{index}" in plan
        assert "TEMP B-TREE" not in plan
