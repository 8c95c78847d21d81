"""Backup, verify and prune: copies of one moment, every fault named, nothing left hanging."""

import io
import math
import random
import sqlite3
import subprocess
import threading
from pathlib import Path

import pytest
from sqlalchemy import (
    Boolean,
    Double,
    LargeBinary,
    String,
    and_,
    create_engine,
    delete,
    func,
    insert,
    make_url,
    select,
    text,
    update,
)
from sqlalchemy.exc import IntegrityError

from service.app.factory import open_app
from service.errors import BadConfiguration
from service.features.pictures.part import Pictures
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.features.pictures.tracker.submit import read_known
from service.observations.schema import OptionsIn, submission_from_json
from service.settings import Settings
from service.storage.projections import rollups
from service.storage.projections.projector import rebuild_trends
from service.storage.recording.identity import digest_of
from service.storage.sql.columns import PackedText, metadata
from service.storage.sql.engines import database_url, reading_engine
from service.storage.sql.tables import (
    batches,
    catalogs,
    frames,
    idempotency_keys,
    mission_uses,
    missions,
    results,
    rollups_daily,
    rollups_hourly,
    solutions,
    star_results,
    tracker_values,
)
from service.storage.store import Store
from service.storage.upkeep.backup import back_up
from service.storage.upkeep.prune import OF_A_BATCH, OF_A_RESULT, prune
from service.storage.upkeep.verify import verify
from service.times import shifted
from tests.scale import draws, size
from tests.storage import twin
from tests.storage.samples import START

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})
KINDS = ("good", "suspect", "one_star", "spurious")


@pytest.fixture
def filled(app, make):
    """Batches of every kind over two days and two runs, a what-if adopted, one with a key."""
    ids = []
    for k in range(12):
        for run in ("live", "r"):
            submission = make(f"b{k}", kind=KINDS[k % 4], run=run, after_s=k * 14_000.0)
            ids.append(app.submissions.submit(submission, f"key-{run}-{k}").id)
    app.results.what_if(ids[0], TIGHT, adopt=True)
    app.results.what_if(ids[-1], TIGHT, record=True)
    return app


def counts(app):
    tables = (batches, results, star_results, solutions, idempotency_keys)
    with app.store.reading() as connection:
        return {t.name: connection.scalar(select(func.count()).select_from(t)) for t in tables}


def change(app, change):
    """Make a change, given as a statement or as a function of a connection."""
    made = change if callable(change) else lambda connection: connection.execute(change)
    app.store.writer.change(made)


def replace_in_input(connection, id, old, new):
    of_batch = batches.c.id == id
    sent = connection.scalar(select(batches.c.input).where(of_batch))
    connection.execute(update(batches).where(of_batch).values(input=sent.replace(old, new)))


# ---- verify ------------------------------------------------------------------------------------


@pytest.mark.both_databases
def test_of_a_sound_database_nothing_is_wrong(filled, database):
    steps = []
    assert verify(database, lambda *step: steps.append(step)) == []
    assert steps[-1] == (24, 24)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (lambda id: delete(star_results).where(star_results.c.result_id == id), "its counts are"),
        (lambda id: delete(solutions).where(solutions.c.result_id == id), "attitude is missing"),
        (
            lambda id: update(results).where(results.c.id == id).values(answer='{"id": "x"'),
            "its answer cannot be read",
        ),
        (
            lambda id: update(results).where(results.c.id == id).values(unique=0, observed=0),
            "its counts are not those of its stars",
        ),
        (
            lambda id: update(results).where(results.c.id == id).values(current=False),
            "0 of its results are current",
        ),
        (
            lambda id: lambda connection: replace_in_input(connection, id, "XTE", "XTF"),
            "its input is not the one that was fingerprinted",
        ),
        (
            lambda id: update(batches).where(batches.c.id == id).values(input="{"),
            "its input cannot be read",
        ),
        (
            lambda id: update(missions).values(
                settings=func.replace(missions.c.settings, "1", "2")
            ),
            "mission settings sha256:",
        ),
        (lambda id: update(rollups_daily).values(unique=rollups_daily.c.unique + 1), "trends of"),
        (
            lambda id: update(rollups_hourly).values(
                residual_rms_arcsec_max=rollups_hourly.c.residual_rms_arcsec_max + 1
            ),
            "not those of the results",
        ),
    ],
)
def test_every_kind_of_damage_is_named(app, make, database, fault, told):
    id = app.submissions.submit(make()).id
    # Some faults are in projections, which follow a moment later.
    app.store.progress.wait()
    assert verify(database) == []
    change(app, fault(id))
    assert any(told in problem for problem in verify(database))


def altered(value, kind, rng):
    """Another value of a column: a letter, a bit, the next double, the next whole number."""
    if isinstance(kind, Double):
        next_one = math.nextafter(value or 0.0, math.inf)
        return 0.5 if value is None else rng.choice([-value or 1.0, next_one])
    if isinstance(kind, String | PackedText):
        text = value or "?"
        place = rng.randrange(len(text))
        return text[:place] + ("~" if text[place] != "~" else "!") + text[place + 1 :]
    if isinstance(kind, Boolean):
        return not value
    if isinstance(kind, LargeBinary):
        place = rng.randrange(len(value))
        return value[:place] + bytes([value[place] ^ 1]) + value[place + 1 :]
    return (value or 0) + 1


RECORD = {
    batches: "id",
    results: "batch_id",
    star_results: "result_id",
    solutions: "result_id",
    frames: "batch_id",
    tracker_values: "batch_id",
    missions: "digest",
    catalogs: "digest",
    mission_uses: "digest",
}
"""What is recorded, and the column by which a fault names it."""
NO_CONTENT = {"results.seq", "mission_uses.id"}
"""Places in an order."""


def rows_of(app, table):
    with app.store.reading() as connection:
        return [dict(row) for row in connection.execute(select(table)).mappings()]


def change_freely(app, statement):
    """Change what the service would not; False where the database itself refuses."""
    try:
        if app.store.url.drivername != "sqlite":
            change(app, statement)
        else:
            # Foreign keys are not held here, as in any other program that opens the file.
            engine = create_engine(app.store.url)
            with engine.begin() as connection:
                connection.execute(statement)
            engine.dispose()
    except IntegrityError:
        return False
    return True


@pytest.mark.both_databases
@pytest.mark.slow("postgresql")
def test_any_changed_value_of_the_record_is_found_and_named(
    filled, framed, opened, missions, database, seed, figures
):
    """Every column; one that refers to another row may be refused by the database itself."""
    rng = random.Random(seed)
    filled.close()
    filled = opened(mission=twin.twin(missions))
    of_two = twin.batch(filled.context.sky, filled.context.missions["XTE"], "two")
    filled.submissions.submit(submission_from_json(of_two))
    rows = {table: found for table in RECORD if (found := rows_of(filled, table))}
    assert rows.keys() == RECORD.keys()
    owner = {row["id"]: row["batch_id"] for row in rows[results]}
    places = [(t, c) for t in RECORD for c in t.columns if f"{t.name}.{c.name}" not in NO_CONTENT]
    tries, refused = max(draws(24, 150), size(1_000)), 0
    for number in range(tries):
        # Each column in turn where there are tries enough.
        is_enough = len(places) <= tries
        table, column = places[number % len(places)] if is_enough else rng.choice(places)
        row = rng.choice(rows[table])
        changed = {column.name: altered(row[column.name], column.type, rng)}
        place = and_(*(key == row[key.name] for key in table.primary_key))
        if not change_freely(filled, update(table).where(place).values(changed)):
            refused += 1
            continue
        found = verify(database)
        key = row[RECORD[table]]
        names = [owner.get(key, key), str(row.get("id", key))]
        if column.primary_key or column.foreign_keys:
            names.append(str(changed[column.name]))
        if table is tracker_values or column is results.c.current:
            # Shown by the trends of the hour, which name spacecraft and run.
            names.append("trends of XTE, run ")
        assert any(name in each for each in found for name in names), (table.name, changed, found)
        now = row | changed
        place = and_(*(key == now[key.name] for key in table.primary_key))
        assert change_freely(filled, update(table).where(place).values(row))
    figures(tries=tries, refused=refused)
    assert refused < tries / 4
    assert verify(database) == []


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_byte_changed_in_the_file_is_found_or_touches_no_content(
    filled, database, tmp_path, seed, figures
):
    rng = random.Random(seed)
    url = f"sqlite:///{tmp_path / 'copy.db'}"
    back_up(database, tmp_path / "copy.db")
    whole = (tmp_path / "copy.db").read_bytes()

    def content():
        engine = reading_engine(database_url(url))
        try:
            with engine.begin() as connection:
                return {
                    f"{table.name}.{each.name}": connection.scalars(
                        select(each).order_by(*table.primary_key)
                    ).all()
                    for table in RECORD
                    for each in table.columns
                    if f"{table.name}.{each.name}" not in NO_CONTENT
                }
        finally:
            engine.dispose()

    before, found = content(), 0
    tries = size(1_000, 10)
    for _ in range(tries):
        data = bytearray(whole)
        place = rng.randrange(len(data))
        data[place] ^= rng.randrange(1, 256)
        (tmp_path / "copy.db").write_bytes(data)
        try:
            told = verify(url)
        except BadConfiguration as error:
            told = [str(error)]
        found += bool(told)
        assert told or content() == before, (place, whole[place], data[place])
    figures(tries=tries, found=found, no_content=tries - found)


@pytest.mark.both_databases
def test_results_that_were_removed_or_added_are_found(filled, database):
    with filled.store.reading() as connection:
        what_if = select(results.c.id).where(~results.c.current, results.c.parent_id.is_not(None))
        removed = connection.scalar(what_if)
        whole = select(results).where(results.c.id == removed)
        row = dict(connection.execute(whole).mappings().one())

    def remove(connection):
        for table in (star_results, solutions):
            connection.execute(delete(table).where(table.c.result_id == removed))
        connection.execute(delete(results).where(results.c.id == removed))

    filled.store.writer.change(remove)
    found, gone = verify(database)
    assert "results were removed, added or exchanged" in found
    assert "it was recorded, and is gone" in gone
    exchanged = row | {"id": "0" * 26}
    exchanged["digest"] = digest_of(exchanged, [], None)
    change(filled, insert(results).values(exchanged))
    assert any("removed, added or exchanged" in each for each in verify(database))


@pytest.mark.both_databases
def test_a_pruned_hour_is_told_from_one_of_which_a_result_was_taken(filled, database, make):
    """What is pruned, forgotten or archived takes its own digests out of the seal, no others."""
    for k in range(3):
        filled.submissions.submit(make(f"late{k}", run="late", after_s=900_000.0 + k))
    with filled.store.reading() as connection:
        chosen = select(results.c.id).where(results.c.run == "late").order_by(results.c.id)
        taken, *_ = connection.scalars(chosen).all()
        place = connection.scalar(select(results.c.seq).where(results.c.id == taken))

    def take(connection):
        for table in (star_results, solutions):
            connection.execute(delete(table).where(table.c.result_id == taken))
        connection.execute(delete(results).where(results.c.id == taken))
        connection.execute(delete(batches).where(batches.c.id == taken))

    filled.store.writer.change(take)
    rebuild_trends(filled.store, lambda done, total: None)
    told = "run late, the hour from 1996-01-20T22:59:30.000Z: results were removed"
    found, gone = verify(database)
    assert told in found
    assert f"the result of place {place}: it was recorded, and is gone" in gone
    assert "3 were recorded, 2 are there" in found
    # The others are pruned: what was taken from the hour still shows, and nothing of the rest.
    prune(filled.store, shifted(START, 1e6))
    assert counts(filled)["batches"] == 0
    found, gone = verify(database)
    assert told in found
    assert f"the result of place {place}: it was recorded, and is gone" in gone
    assert "1 were recorded, 0 are there" in found


@pytest.mark.both_databases
def test_rows_that_were_exchanged_between_results_are_found(filled, database):
    """Each whole row is one that was recorded; it stands in another's place."""
    with filled.store.reading() as connection:
        chosen = select(func.min(results.c.id)).group_by(results.c.status)
        one, other = sorted(connection.scalars(chosen.where(results.c.status.is_not(None))))
    for table in (solutions, star_results):
        of_both = table.c.result_id.in_([one, other])
        rows = [row for row in rows_of(filled, table) if row["result_id"] in (one, other)]
        in_turn = {one: other, other: one}
        exchanged = [row | {"result_id": in_turn[row["result_id"]]} for row in rows]
        for inserted, wrong in ((exchanged, [one, other]), (rows, [])):
            change(filled, delete(table).where(of_both))
            change(filled, insert(table).values(inserted))
            told = [f"result {id} of batch {id}: it is not what was recorded" for id in wrong]
            found = verify(database)
            of_the_chain = [each for each in found if "it is not what the chain has" in each]
            assert sorted(set(found) - set(of_the_chain)) == told
            assert len(of_the_chain) == len(wrong)


@pytest.fixture
def framed(app, missions):
    """The id of a batch that was made of a frame."""
    (drawn,) = draw_frames(missions["IMAGER"], app.sky, FrameSettings(frames=1, seed=5))
    known = read_known(drawn.known)
    return app.part(Pictures).frames.submit("IMAGER", known, io.BytesIO(frame_bytes(drawn))).id


def test_a_sound_batch_made_of_a_frame_is_not_called_damaged(app, framed, database):
    app.results.what_if(framed, OptionsIn(solver="triad"), record=True, adopt=False)
    assert verify(database) == []


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (
            lambda id: (
                lambda connection: replace_in_input(connection, id, '"magnitude":', '"magnitude":1')
            ),
            "stars of its input are not those of its frame",
        ),
        (lambda id: update(frames).values(digest="sha256:0"), "is about another frame"),
        (lambda id: update(frames).values(detections="{"), "cannot be read"),
    ],
)
def test_damage_to_a_batch_made_of_a_frame_is_named(app, framed, database, fault, told):
    change(app, fault(framed))
    assert any(told in problem for problem in verify(database))


def test_a_file_that_is_damaged_is_told_from_a_sound_one(filled, tmp_path):
    if filled.store.url.drivername != "sqlite":
        pytest.skip("PostgreSQL looks after its own files")
    copy = tmp_path / "copy.db"
    back_up(f"sqlite:///{filled.store.url.database}", copy)
    data = bytearray(copy.read_bytes())
    with sqlite3.connect(copy) as connection:
        root = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'ix_results_current_by_run'"
        ).fetchone()[0]
        page = connection.execute("PRAGMA page_size").fetchone()[0]
    data[(root - 1) * page + page // 2 : root * page] = b"\xaa" * (page - page // 2)
    copy.write_bytes(bytes(data))
    problems = verify(f"sqlite:///{copy}")
    assert any("the file is damaged" in problem for problem in problems)


def test_a_database_that_is_behind_or_not_there_is_told_of(tmp_path):
    with pytest.raises(BadConfiguration, match="there is no such file"):
        verify(f"sqlite:///{tmp_path}/none.db")
    (tmp_path / "empty.db").touch()
    assert "acquire database upgrade" in verify(f"sqlite:///{tmp_path}/empty.db")[0]


# ---- backup ------------------------------------------------------------------------------------


def restored(database, dump, tmp_path):
    """The URL of a database that is the backup alone."""
    if database.startswith("sqlite"):
        return f"sqlite:///{dump}"
    url = make_url(database)
    schema = url.query["options"].split("search_path=")[1].split(" ")[0]
    engine = create_engine(database_url(database), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))
    engine.dispose()
    plain = url.set(drivername="postgresql", query={}).render_as_string(hide_password=False)
    subprocess.run(["pg_restore", f"--dbname={plain}", "--no-owner", str(dump)], check=True)
    return database


@pytest.mark.both_databases
def test_a_backup_is_whole_and_serves_in_the_place_of_the_database(
    filled, database, tmp_path, make
):
    before, listed = counts(filled), filled.results.page(run="r", limit=500).items
    back_up(database, tmp_path / "copy")
    filled.submissions.submit(make("after", after_s=5.0))
    filled.close()
    copy = restored(database, tmp_path / "copy", tmp_path)
    assert verify(copy) == []
    app = open_app(Settings(database=copy))
    try:
        assert counts(app) == before
        assert app.results.page(run="r", limit=500).items == listed
        assert app.submissions.submit(make("after", after_s=5.0)).replayed is False
    finally:
        app.close()


@pytest.mark.both_databases
def test_a_backup_while_batches_are_recorded_is_of_one_moment(opened, make, database, tmp_path):
    """Every batch in it is whole, those acknowledged before it are in, and it ends."""
    app = opened()
    submissions = [make(f"b{k}", after_s=float(k)) for k in range(60)]
    acknowledged = [app.submissions.submit(each).id for each in submissions[:20]]
    go_on = threading.Event()

    def keep_recording():
        for each in submissions[20:]:
            app.submissions.submit(each)
            go_on.wait(0.01)

    thread = threading.Thread(target=keep_recording)
    thread.start()
    try:
        back_up(database, tmp_path / "copy")
    finally:
        go_on.set()
        thread.join()
    app.close()
    copy = restored(database, tmp_path / "copy", tmp_path)
    assert verify(copy) == []
    store = Store(copy)
    try:
        with store.reading() as connection:
            assert set(acknowledged) <= set(connection.scalars(select(batches.c.id)))
    finally:
        store.close()


def test_commits_between_two_pages_do_not_begin_a_copy_anew(tmp_path, opened, make, monkeypatch):
    """A page at a time, with a commit after each: it still ends, and is of its first moment."""
    app = opened()
    if app.store.url.drivername != "sqlite":
        pytest.skip("PostgreSQL has snapshots of its own")
    app.submissions.submit(make("first"))
    monkeypatch.setattr("service.storage.upkeep.backup.PAGES_AT_ONCE", 20)
    steps = []

    def commit(left, total):
        steps.append((left, total))
        app.submissions.submit(make(f"b{len(steps)}", after_s=float(len(steps))))

    back_up(f"sqlite:///{app.store.url.database}", tmp_path / "copy.db", commit)
    assert len(steps) >= 3
    lefts = [left for left, _ in steps]
    assert lefts == sorted(lefts, reverse=True)
    with sqlite3.connect(tmp_path / "copy.db") as connection:
        assert connection.execute("SELECT batch FROM batches").fetchall() == [("first",)]
    assert verify(f"sqlite:///{tmp_path / 'copy.db'}") == []


def test_a_backup_never_writes_over_anything_and_leaves_no_half_of_one(database, tmp_path):
    there = tmp_path / "there"
    there.write_text("mine")
    with pytest.raises(BadConfiguration, match="exists already"):
        back_up(database, there)
    assert there.read_text() == "mine"
    with pytest.raises(BadConfiguration, match="no such folder"):
        back_up(database, tmp_path / "none" / "copy")
    with pytest.raises(BadConfiguration, match="no such file"):
        back_up(f"sqlite:///{tmp_path}/none.db", tmp_path / "copy")
    broken = tmp_path / "broken.db"
    broken.write_bytes(b"no database at all" * 100)
    with pytest.raises(BadConfiguration, match="cannot be copied"):
        back_up(f"sqlite:///{broken}", tmp_path / "copy")
    left = {path.name for path in Path(tmp_path).iterdir() if not path.name.startswith("acquire")}
    assert left == {"there", "broken.db"}


# ---- prune -------------------------------------------------------------------------------------


@pytest.mark.both_databases
def test_what_is_before_is_gone_and_what_is_after_is_as_it_was(filled, database, make):
    """Cut within an hour: the trends are those of what is left."""
    cut = shifted(START, 5 * 14_000.0 + 1.0)
    after = [i for i in filled.results.page(limit=500).items if i.time >= cut.text]
    records = {item.id: filled.results.get(item.id) for item in after}
    steps = []
    pruned = prune(filled.store, cut, step=lambda p: steps.append((p.batches, p.total)))
    assert (pruned.batches, pruned.total) == (12, 12)
    assert steps[0] == (0, 12)
    assert steps[-1] == (12, 12)
    assert filled.results.page(limit=500).items == after
    assert {id: filled.results.get(id) for id in records} == records
    assert verify(database) == []
    left = counts(filled)
    assert (left["batches"], left["results"], left["idempotency_keys"]) == (12, 13, 12)
    # What was deleted can come again, as if it had never been.
    assert not filled.submissions.submit(make("b0", kind="good"), "key-live-0").replayed


def test_of_one_run_alone(filled, database):
    before = filled.results.page(limit=500).items
    pruned = prune(filled.store, shifted(START, 1e6), "r")
    assert (pruned.batches, filled.results.page(run="r").items) == (12, [])
    assert filled.results.page(limit=500).items == before
    assert [run.run for run in filled.runs.all()] == ["live"]
    assert verify(database) == []


def test_a_dry_run_counts_and_deletes_nothing(filled):
    before = counts(filled)
    assert prune(filled.store, shifted(START, 5 * 14_000.0), dry_run=True).total == 10
    assert counts(filled) == before


def test_an_hour_that_is_cut_keeps_its_later_part_in_the_trends(app, make, database):
    for k in range(6):
        app.submissions.submit(make(f"b{k}", after_s=k * 60.0, kind=KINDS[k % 4]))
    prune(app.store, shifted(START, 180.0))
    (hour,) = app.spacecraft.rates("XTE")
    (day,) = app.spacecraft.rates("XTE", bucket="day")
    assert (hour.batches, day.batches) == (3, 3)
    with app.store.reading() as connection:
        for bucket in ("hour", "day"):
            assert rollups.stored(connection, bucket) == rollups.recount(connection, bucket)
    assert verify(database) == []


def test_stopped_it_has_taken_out_whole_hours_and_goes_on(filled, database):
    class Stopped(Exception):
        pass

    def stop(pruned):
        if pruned.batches >= 3:
            raise Stopped

    with pytest.raises(Stopped):
        prune(filled.store, shifted(START, 1e6), step=stop)
    assert verify(database) == []
    pruned = prune(filled.store, shifted(START, 1e6))
    assert pruned.batches == pruned.total == 24 - 3
    assert counts(filled) == dict.fromkeys(counts(filled), 0)


@pytest.mark.both_databases
def test_a_dense_hour_goes_in_parts_and_between_them_the_trends_are_right(
    app, make, database, monkeypatch
):
    """As many batches as fill the last part, and one more of the hour that stays."""
    monkeypatch.setattr("service.storage.upkeep.prune.MOST_BATCHES", 3)
    for k in range(10):
        app.submissions.submit(make(f"b{k}", after_s=k * 60.0, kind=KINDS[k % 4]))
    seen = []

    def step(pruned):
        (hour,) = app.spacecraft.rates("XTE")
        left = [item.batch for item in app.results.page().items]
        seen.append((pruned.batches, hour.batches, left[-1]))
        assert verify(database) == []

    assert prune(app.store, shifted(START, 540.0), step=step).batches == 9
    assert seen[:4] == [(0, 10, "b0"), (3, 7, "b3"), (6, 4, "b6"), (9, 1, "b9")]


@pytest.mark.both_databases
def test_while_it_prunes_batches_are_recorded(app, make, database):
    """The first hour is pruned while the second is filled."""
    for k in range(20):
        app.submissions.submit(make(f"old{k}", after_s=float(k)))
    thread = threading.Thread(target=prune, args=(app.store, shifted(START, 3600.0)))
    thread.start()
    new = [app.submissions.submit(make(f"new{k}", after_s=7200.0 + k)).id for k in range(20)]
    thread.join()
    left = app.results.page(limit=500).items
    assert sorted(item.id for item in left) == sorted(new)
    assert verify(database) == []


def test_of_whatever_refers_to_a_batch_nothing_is_left_hanging():
    """Every table of the code that refers to results or batches is one that is pruned."""
    for target, pruned in ((results, OF_A_RESULT), (batches, OF_A_BATCH)):
        refer = {
            table
            for table in metadata.sorted_tables
            for key in table.foreign_keys
            if key.column.table is target and table is not results
        }
        assert refer == set(pruned)


@pytest.mark.both_databases
def test_what_refers_to_a_result_is_found_without_reading_every_row(app):
    """Deleting a result asks for its keys and its what-ifs."""
    questions = {
        "ix_idempotency_keys_result_id": "FROM idempotency_keys WHERE result_id = 'x'",
        "ix_results_parent": "FROM results WHERE parent_id = 'x'",
    }
    with app.store.reading() as connection:
        if connection.dialect.name == "sqlite":
            explain = "EXPLAIN QUERY PLAN"
        else:
            # Of tables this small it would read every row, which is no answer.
            connection.exec_driver_sql("SET LOCAL enable_seqscan = off")
            explain = "EXPLAIN"
        for index, question in questions.items():
            plan = connection.exec_driver_sql(f"{explain} SELECT 1 {question}").all()
            assert index in str(plan)
