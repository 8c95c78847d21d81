"""A record that is copied to another database arrives whole, or is no record that a service opens.

A record goes from SQLite to the other kind of database and back.
"""

import math
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import (
    BigInteger,
    Boolean,
    Double,
    Integer,
    LargeBinary,
    SmallInteger,
    create_engine,
    func,
    insert,
    select,
    update,
)
from sqlalchemy.pool import NullPool

from service.app.factory import open_app
from service.errors import BadConfiguration
from service.features.alarms.part import Alarms
from service.observations.schema import OptionsIn
from service.settings import Settings
from service.storage.sql.columns import HAS_FIRST_ROW
from service.storage.sql.engines import database_url
from service.storage.sql.migrations import UNFINISHED, all_tables, check, revision_of, upgrade
from service.storage.sql.statements import insert_all
from service.storage.sql.tables import batches, projector, results, runs
from service.storage.upkeep import copy
from service.storage.upkeep.copy import copy_record
from service.storage.upkeep.verify import verify
from tests.databases.make import restore_sqlite
from tests.fresh_databases import sqlite_at
from tests.scale import draws, size
from tests.storage.samples import KINDS
from tests.storage.test_restore import clear
from tests.waiting import wait_until

pytestmark = pytest.mark.both_databases

CHECKOUT = Path(__file__).parents[2]
GIVE_UP_S = 120.0
TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})
LETTERS = "aZ09 _-.'\"\\\n\t,;%é漢😀"


@contextmanager
def connected(url):
    engine = create_engine(database_url(url), poolclass=NullPool)
    with engine.begin() as connection:
        yield connection
    engine.dispose()


def rows_of(url):
    """Every row of every table, in an order that does not depend on the database."""
    with connected(url) as connection:
        return {
            table.name: sorted(repr(tuple(row)) for row in connection.execute(select(table)))
            for table in all_tables()
        }


def filled(app, make, count=24):
    """Batches of every kind in two runs, with keys, what-ifs, and a limit."""
    ids = [
        app.submissions.submit(
            make(f"b{k}", kind=KINDS[k % 4], run=("live", "r")[k % 2], after_s=k * 900.0),
            f"key-{k}",
        ).id
        for k in range(count)
    ]
    app.results.what_if(ids[0], TIGHT, adopt=True)
    app.results.what_if(ids[-1], TIGHT, record=True)
    app.part(Alarms).limits.set("XTE", "residual_ratio", None, who="me")


@pytest.fixture
def recorded(opened, make, tmp_path):
    """The URL of an SQLite database with a record, which nothing has open."""
    url = sqlite_at(tmp_path / "recorded.db")
    app = opened(database=url)
    filled(app, make)
    app.close()
    return url


# ---- what arrives --------------------------------------------------------------------------------


def fill_at_random(connection, rng, count):
    """Random rows of every table that keep all that the schema demands, and no more."""
    keys = {}
    for table in all_tables():
        if HAS_FIRST_ROW in table.info:
            connection.execute(
                update(table).values({list(table.c)[-1]: int(rng.integers(1 << 40))})
            )
            continue
        rows = [
            {column.name: drawn(rng, column, k, keys) for column in table.c} for k in range(count)
        ]
        keys |= {column: [row[column.name] for row in rows] for column in table.c}
        insert_all(connection, table, rows)
    # Results that refer to what stands before and behind them.
    for id in keys[results.c.id]:
        parent = rng.choice([None, *keys[results.c.id]])
        connection.execute(update(results).where(results.c.id == id).values(parent_id=parent))


def drawn(rng, column, k, keys):
    """A value of the row `k`; those of two rows are distinct, unless they are null or true."""
    for key in column.foreign_keys:
        return keys[key.column][k] if key.column in keys else None
    if column.nullable and rng.random() < 0.3:
        return None
    kind = column.type
    if isinstance(kind, Boolean):
        return bool(rng.random() < 0.5)
    if isinstance(kind, Integer):
        bits = {SmallInteger: 15, BigInteger: 63}.get(type(kind), 31)
        return int(rng.integers((1 << bits) // 1000)) * 1000 + k
    if isinstance(kind, Double):
        return float(rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(-740.0, 709.0)))
    if isinstance(kind, LargeBinary):
        return rng.bytes(int(rng.integers(300)))
    letters = rng.choice(
        list(LETTERS), size=int(rng.integers((getattr(kind, "length", None) or 400) - 5))
    )
    return f"{k:05}" + "".join(letters)


def test_every_value_of_every_table_arrives_and_comes_back(database, tmp_path, rng, monkeypatch):
    monkeypatch.setattr(copy, "ROWS_AT_ONCE", 7)
    # Random rows are no record.
    monkeypatch.setattr(copy, "verify", lambda *_: [])
    source, back = sqlite_at(tmp_path / "source.db"), f"sqlite:///{tmp_path / 'back.db'}"
    with connected(source) as connection:
        fill_at_random(connection, rng, draws(20, 200))
    before = rows_of(source)
    assert all(before.values())
    copy_record(source, database)
    assert rows_of(database) == before
    copy_record(database, back)
    assert rows_of(back) == before
    assert rows_of(source) == before


def test_exports_of_the_copies_are_the_same_bytes(acquire, recorded, database, tmp_path):
    def exported(url):
        found = {}
        for what in ("batches", "stars", "attitude"):
            for run in ("live", "r"):
                wanted = ("--spacecraft", "XTE", "--run", run, "--database", url)
                code, found[what, run], complaint = acquire("export", what, *wanted)
                assert (code, complaint) == (0, "")
        return found

    back = f"sqlite:///{tmp_path / 'back.db'}"
    before = exported(recorded)
    assert all(text.count("\n") > 5 for text in before.values())
    assert copy_record(recorded, database)[1] == []
    assert copy_record(database, back)[1] == []
    assert exported(database) == before
    assert exported(back) == before


def test_a_copy_goes_on_recording_where_its_source_ended(recorded, database, opened, make):
    copy_record(recorded, database)
    app = opened()
    known = app.submissions.submit(make("b0", kind=KINDS[0]), "key-0")
    assert rows_of(recorded)["batches"] == rows_of(database)["batches"]
    assert known.id in str(rows_of(recorded)["results"])
    app.submissions.submit(make("new", after_s=90_000.0))
    app.part(Alarms).limits.set("XTE", "unmatched_share", None, who="me")
    app.close()
    with connected(database) as connection:
        newest, position = (
            connection.scalar(select(func.max(table.c.seq))) for table in (results, projector)
        )
    with connected(recorded) as connection:
        assert newest > connection.scalar(select(func.max(results.c.seq)))
    assert position == newest
    assert verify(database) == []


# ---- interrupted ---------------------------------------------------------------------------------


def run_and_kill(source, target, output, steps, after_s):
    """Kill a worker `after_s` after so many transactions; False: it had finished."""
    command = [sys.executable, "-m", "tests.storage.copy_worker", source, target]
    with output.open("wb") as stdout:
        worker = subprocess.Popen(command, stdout=stdout, cwd=CHECKOUT)
        wait_until(
            lambda: output.read_bytes().count(b"\n") >= steps or worker.poll() is not None,
            GIVE_UP_S,
            why="the worker copied nothing",
            every_s=0.002,
        )
        time.sleep(after_s)
        worker.kill()
        code = worker.wait()
    assert code in (0, -signal.SIGKILL)
    return code != 0


def has_begun(target):
    """Whether a worker lived until there was a database to copy to."""
    return not target.startswith("sqlite") or Path(database_url(target).database).is_file()


@pytest.mark.slow
@pytest.mark.torture
def test_a_copy_that_is_killed_at_any_moment_goes_on(recorded, database, tmp_path, rng, figures):
    """From SQLite to the other database and back, until it was killed often enough."""
    before = rows_of(recorded)
    killed, copies, kills = 0, 0, size(200)
    while killed < kills or copies < 2:
        back = f"sqlite:///{tmp_path / f'back{copies}.db'}"
        source, target = (database, back) if copies % 2 else (recorded, database)
        if target is database:
            clear(database)
        # A worker that has finished before it was killed shows nothing.
        while run_and_kill(
            source, target, tmp_path / "out", int(rng.integers(0, 150)), float(rng.uniform(0, 0.02))
        ):
            killed += 1
            if has_begun(target) and (revision_of(target) or "").startswith(UNFINISHED):
                assert "is an unfinished copy" in check(target)[0]
        assert verify(target) == []
        assert rows_of(target) == before
        copies += 1
    figures(kills=killed, copies=copies)


class Stopped(Exception):
    """Ends a copy in the middle."""


def begin(source, target, monkeypatch):
    """Leave an unfinished copy."""

    def step(what, done, total):
        if done > total / 2:
            raise Stopped

    monkeypatch.setattr(copy, "ROWS_AT_ONCE", 5)
    with pytest.raises(Stopped):
        copy_record(source, target, step)


def test_an_unfinished_copy_is_served_by_nobody(recorded, database, monkeypatch):
    begin(recorded, database, monkeypatch)
    (difference,) = check(database)
    assert "is an unfinished copy: run the same `acquire database copy` again" in difference
    with pytest.raises(BadConfiguration, match="is an unfinished copy"):
        open_app(Settings(database=database, replay_processes=0))
    with pytest.raises(BadConfiguration, match="is an unfinished copy"):
        upgrade(database)
    with pytest.raises(BadConfiguration, match=r"FROM: .* is an unfinished copy"):
        copy_record(database, recorded)
    copy_record(recorded, database)
    assert verify(database) == []


def change_answers(connection):
    connection.execute(update(results).values(identifier="ptp"))


def add_a_run(connection):
    connection.execute(insert(runs).values(name="new", created="1996-01-10T12:00:00.000Z"))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (change_answers, "the rows of results are not those of the source"),
        (add_a_run, "an unfinished copy of another database, or of an earlier state"),
    ],
)
def test_a_source_that_was_changed_meanwhile_is_noticed(
    recorded, database, monkeypatch, change, reason
):
    begin(recorded, database, monkeypatch)
    with connected(recorded) as connection:
        change(connection)
    with pytest.raises(BadConfiguration, match=reason):
        copy_record(recorded, database)
    assert "is an unfinished copy" in check(database)[0]


# ---- refused -------------------------------------------------------------------------------------


def test_no_record_is_copied_over_another(recorded, database, opened, make):
    app = opened()
    app.submissions.submit(make("other"))
    app.close()
    before = rows_of(database)
    with pytest.raises(BadConfiguration, match=r"TO: .*it holds a record already: name an empty"):
        copy_record(recorded, database)
    assert rows_of(database) == before


def test_nothing_is_copied_beside_a_service(recorded, database, tmp_path, make):
    app = open_app(Settings(database=database, replay_processes=0), serving=True)
    try:
        wait_until(lambda: app.store.is_projecting)
        app.submissions.submit(make())
        new = tmp_path / "new.db"
        with pytest.raises(BadConfiguration, match=r"FROM: .*(writes to it|is using it)"):
            copy_record(database, f"sqlite:///{new}")
        assert not new.exists()
        with pytest.raises(BadConfiguration, match=r"TO: .*(writes to it|is using it)"):
            copy_record(recorded, database)
    finally:
        app.close()


def test_both_need_the_schema_of_this_version(recorded, empty_database, tmp_path):
    restore_sqlite("0001", tmp_path / "earlier.db")
    earlier = f"sqlite:///{tmp_path / 'earlier.db'}"
    with pytest.raises(BadConfiguration, match=r"FROM: .* the schema 0001: upgrade it with `git"):
        copy_record(earlier, empty_database)
    with pytest.raises(BadConfiguration, match=r"TO: .* the schema 0001: upgrade it with `git"):
        copy_record(recorded, earlier)
    assert revision_of(earlier) == "0001"


def test_results_of_an_earlier_commit_are_copied(empty_database, tmp_path):
    """Also where they have no digests yet."""
    restore_sqlite("0018", tmp_path / "earlier.db")
    source = f"sqlite:///{tmp_path / 'earlier.db'}"
    assert copy_record(source, empty_database)[1] == []
    assert rows_of(empty_database) == rows_of(source)


def test_the_command_says_what_it_copied_and_that_it_is_equal(acquire, recorded, tmp_path):
    code, out, complaint = acquire("database", "copy", recorded, "sqlite:///new.db")
    assert (code, complaint) == (0, "")
    rows = sum(map(len, rows_of(recorded).values()))
    assert out == f"{rows} rows were copied and compared; nothing is wrong with the copy\n"
    assert (tmp_path / "new.db").stat().st_mode & 0o777 == 0o600
    assert acquire("database", "copy", recorded, "sqlite:///new.db") == (code, out, complaint)


def test_the_command_names_the_faults_of_a_source(acquire, recorded):
    with connected(recorded) as connection:
        connection.execute(update(batches).values(fingerprint="0" * 64))
    code, out, _ = acquire("database", "copy", recorded, "sqlite:///new.db")
    assert code == 1
    assert "its input is not the one that was fingerprinted" in out
    assert "the copy equals its source" in out
