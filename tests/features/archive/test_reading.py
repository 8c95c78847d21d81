"""Archived batches are seen as recorded ones are: the same lists, pages, products and what-ifs."""

from itertools import chain

import pytest
from msgspec import structs
from sqlalchemy import inspect

from service.errors import Busy, NotAvailable, WrongState
from service.features.archive import archiving, folder
from service.features.archive.archiving import PartFilter, restore
from service.features.products.part import Products
from service.observations.schema import OptionsIn
from service.storage.queries import compare_runs
from service.storage.queries.pages import ResultFilter, count
from service.storage.sql.tables import batches, results
from service.times import shifted
from tests.storage.samples import START

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-6}})
VOTES = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})
KINDS = ("good", "suspect", "one_star", "spurious", "two_trackers")
DAY_S = 86_400.0
BATCHES, STEP_S = 6, 40_000.0
LATER = shifted(START, 10 * DAY_S)
FILTERS = (
    {},
    {"spacecraft": "XTE"},
    {"run": "*"},
    {"run": "r", "status": "none"},
    {"outcome": "unmatched"},
    {"start": shifted(START, 50_000.0), "end": shifted(START, 190_000.0)},
    {"spacecraft": "XTE", "run": "*", "batch": "b3"},
)


@pytest.fixture
def place(tmp_path):
    (tmp_path / "archive").mkdir()
    return tmp_path / "archive"


@pytest.fixture
def app(opened, place):
    return opened(archive_folder=place)


@pytest.fixture
def filled(app, make, monkeypatch):
    """Batches of every kind over three days and two runs, in parts of several row groups."""
    # A batch and its what-ifs then stand in two row groups.
    monkeypatch.setattr(folder, "ROWS_TOGETHER", 2)
    ids = []
    for k in range(BATCHES):
        for run in ("live", "r"):
            submission = make(f"b{k}", kind=KINDS[k % 5], run=run, after_s=k * STEP_S)
            ids.append(app.submissions.submit(submission).id)
    for id in ids[:2]:
        app.results.what_if(id, TIGHT, adopt=True)
        app.results.what_if(id, TIGHT, record=True)
    return app


def pages_of(app, limit, **selected):
    """The items of a list, read page by page."""
    items, cursor = [], None
    while True:
        page = app.results.page(**selected, limit=limit, cursor=cursor)
        assert len(page.items) <= limit
        items += page.items
        cursor = page.next_cursor
        if cursor is None:
            return items


def attitudes_of(app, limit):
    items, cursor = [], None
    while True:
        page = app.spacecraft.attitudes("XTE", limit=limit, cursor=cursor)
        items += page.items
        cursor = page.next_cursor
        if cursor is None:
            return items


def table_of(app, kind, **period):
    return [page for page in app.part(Products).table("XTE", kind, **period).pages if page]


def joined(pages):
    return [list(chain.from_iterable(columns)) for columns in zip(*pages, strict=True)]


def without_mark(items):
    return [structs.replace(each, archived=False) for each in items]


@pytest.mark.both_databases
def test_lists_are_the_same_before_and_after_archiving(filled, place, monkeypatch):
    before = [pages_of(filled, 100, **selected) for selected in FILTERS]
    archiving.archive(filled.store, place, LATER)
    for limit in (1, 3, 100):
        after = [pages_of(filled, limit, **selected) for selected in FILTERS]
        assert [without_mark(each) for each in after] == before
    marked = {each.batch: each.archived for each in after[0]}
    assert marked == {f"b{k}": k < BATCHES - 1 for k in range(BATCHES)}
    # Few row groups are held in memory.
    cache = filled.store.archive.cache
    cache.drop()
    monkeypatch.setattr(cache, "max_bytes", 200_000)
    assert pages_of(filled, 2, **FILTERS[2]) == after[2]
    state = cache.state()
    assert state.nbytes <= 200_000
    assert state.evictions > 0
    # A page that looks into few row groups is short, and goes on at its cursor.
    monkeypatch.setattr("service.storage.queries.pages.MOST_OPENED", 1)
    after = [pages_of(filled, 3, **selected) for selected in FILTERS]
    assert [without_mark(each) for each in after] == before


def test_records_what_they_show_and_what_ifs_are_the_same(filled, place):
    ids = [each.id for each in pages_of(filled, 100, run="*")]

    def seen():
        record = [filled.results.get(id) for id in ids]
        return {
            "records": [
                structs.replace(each, archived=False, what_ifs=without_mark(each.what_ifs))
                for each in record
            ],
            "fields": [filled.results.star_field(id) for id in ids],
            "trackers": [filled.results.trackers(id) for id in ids],
            "settings": [filled.results.settings_for(id) for id in ids],
        }, [each.archived for each in record]

    def around():
        found = [filled.results.neighbours(id) for id in ids]
        sides = [(each.earlier, each.later) for each in found]
        return [[side and side.id for side in each] for each in sides], [f.current for f in found]

    def tried():
        return filled.results.what_if(ids[-3], TIGHT).body.split(b'"timings_us"')[0]

    before, none = seen()
    near, answer = around(), tried()
    archiving.archive(filled.store, place, LATER)
    after, archived = seen()
    assert repr(after) == repr(before)
    assert around() == near
    assert tried() == answer
    for asked in ({"record": True}, {"adopt": True}):
        with pytest.raises(WrongState, match="acquire archive restore"):
            filled.results.what_if(ids[-3], TIGHT, **asked)
    assert not any(none)
    assert archived.count(False) == 2


def test_products_and_their_numbers_are_the_same(filled, place):
    period = {"start": shifted(START, 30_000.0), "end": shifted(START, 200_000.0)}

    products = filled.part(Products)

    def seen():
        return repr(
            (
                attitudes_of(filled, 4),
                [joined(table_of(filled, kind)) for kind in ("batches", "stars")],
                [joined(table_of(filled, kind, **period)) for kind in ("batches", "stars")],
                [
                    [vars(each) for each in products.attitudes("XTE", order=order).blocks]
                    for order in ("oldest", "newest")
                ],
                products.attitude_at("XTE", shifted(START, 4 * STEP_S), "nearest"),
            )
        )

    selections = [
        ResultFilter("live", "XTE"),
        ResultFilter(None, None, None, shifted(START, 100_000.0)),
        ResultFilter("r", "XTE", shifted(START, 60_000.0), shifted(START, 100_000.0)),
    ]

    def counted(most):
        with filled.store.reading() as connection:
            return [count(connection, filled.store.archive, each, most) for each in selections]

    before, numbers = seen(), counted(1000)
    assert min(numbers) > 0
    archiving.archive(filled.store, place, LATER)
    assert seen() == before
    assert counted(1000) == numbers
    assert counted(2) == [min(each, 2) for each in numbers]


def compared_of(app):
    """Comparisons of runs and of options, without times of computing."""
    found = app.comparisons.of_options("XTE", OptionsIn(), VOTES, run="r")
    sides = [structs.replace(each, us_per_batch=None) for each in (found.a, found.b)]
    return (
        structs.replace(found, a=sides[0], b=sides[1]),
        # As text: a share of an hour without stars is NaN, which equals nothing.
        repr(app.runs.rates("live", "r", "XTE")),
        app.runs.compare("live", "r"),
        app.runs.compare("live", "r", "XTE", shifted(START, 30_000.0), shifted(START, 99_000.0)),
        *(app.runs.compare_latest(*runs, "XTE") for runs in (("live", "r"), ("r", "live"))),
    )


@pytest.mark.both_databases
def test_comparisons_are_the_same_wherever_the_batches_are(filled, place, monkeypatch):
    before = compared_of(filled)
    assert before[0].changed_batches > 0
    archiving.archive(filled.store, place, LATER)
    assert compared_of(filled) == before
    restore(filled.store, place, PartFilter(run="r"))
    monkeypatch.setattr(compare_runs, "GROUP", 2)
    assert compared_of(filled) == before


@pytest.mark.both_databases
def test_runs_in_the_archive_are_joined_by_the_indexes_of_the_record(filled, place):
    """Without them a comparison of two thousand batches took a minute."""
    archiving.archive(filled.store, place, LATER)
    with filled.store.reading() as connection:
        archive, live = filled.store.archive, ResultFilter(run="live")
        (group,) = compare_runs.both_runs(connection, archive, live, "r", None)
        with group.reading() as of_group:
            for table in (batches, results):
                there = {each["name"] for each in inspect(of_group).get_indexes(table.name)}
                assert there == {each.name for each in table.indexes}


def test_a_page_of_recorded_batches_needs_no_archive(filled, place):
    """And without the folder every other list says what to do."""
    (id,) = [each.id for each in pages_of(filled, 100, batch="b1", spacecraft="XTE")]
    archiving.archive(filled.store, place, LATER)
    place.rename(place.with_name("away"))
    (newest,) = filled.results.page(limit=5, start=shifted(START, (BATCHES - 1.5) * STEP_S)).items
    assert not newest.archived
    assert filled.results.get(newest.id).current
    assert filled.results.neighbours(newest.id).earlier is None
    for read in (
        lambda: filled.results.page(limit=5),
        lambda: filled.results.get(id),
        lambda: attitudes_of(filled, 5),
        lambda: table_of(filled, "stars"),
    ):
        with pytest.raises(Busy, match="ACQUIRE_ARCHIVE_FOLDER"):
            read()


def test_without_the_setting_an_archived_batch_is_no_matter_of_trying_again(filled, place, opened):
    (id,) = [each.id for each in pages_of(filled, 100, batch="b1", spacecraft="XTE")]
    archiving.archive(filled.store, place, LATER)
    filled.close()
    with pytest.raises(NotAvailable, match="set ACQUIRE_ARCHIVE_FOLDER to the folder"):
        opened(archive_folder=None).results.get(id)
