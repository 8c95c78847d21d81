"""A record in signed heads, and what a person with access to the database does to it."""

import io
from contextlib import contextmanager, suppress

from sqlalchemy import create_engine, insert, select, text, update

from service.errors import Busy
from service.features.definitive.part import Definitive
from service.features.pictures.part import Pictures
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.features.pictures.tracker.submit import read_known
from service.gyro.blocks import GyroBlockIn, block_from_model
from service.observations.schema import OptionsIn
from service.storage.projections import heads, seals
from service.storage.projections.rollups import lock_position
from service.storage.recording.identity import SETTINGS, digest_of, digest_of_row
from service.storage.sql import tables
from service.storage.sql.chain_tables import record_facts, record_heads, record_leaves
from service.storage.sql.dialects import dialect_of
from service.storage.sql.engines import database_url
from service.storage.sql.migrations import all_tables
from service.storage.sql.statements import owned_rows, rows_of
from service.storage.upkeep import verify_chain
from tests.storage.samples import START
from tests.waiting import wait_until

TIGHT = OptionsIn.model_validate({"identifier": "starid", "tolerances": {"separation_deg": 1e-5}})
BATCHES = {
    **dict(enumerate(("good", "suspect", "one_star", "spurious", "good"))),
    # In a later hour, so that the others can be archived.
    50: "good",
}
"""What is to come of a batch, by its time in units of ten minutes."""
ID = "01JD000000000000000000000{}"
_ADOPTION = {"spacecraft": "XTE", "adopted": "", "who": "A", "note": "n"}
_TOKEN = {"scopes": "read", "created": "", "expires": ""}
_ALARM = {"spacecraft": "XTE", "run": "live", "quantity": "unique", "severity": "warning"} | {
    "raised_at": "",
    "bound": 1.0,
    **{f"{which}_value": 0.5 for which in ("raised", "worst", "latest")},
    **{f"{which}_time": "" for which in ("raised", "worst", "latest")},
}
ROWS = [
    ("audit", {"id": ID.format(1), "moment": "", "who": "A", "action": "x", "about": "y"}),
    ("access_tokens", _TOKEN | {"id": ID.format(2), "name": "A", "digest": "d"}),
    ("access_tokens", _TOKEN | {"id": ID.format(5), "name": "B", "digest": "e", "revoked": ""}),
    ("limits", {"spacecraft": "XTE", "quantity": "unique", "who": "A", "since": ""}),
    ("limits", {"spacecraft": "XTE", "quantity": "taste", "who": "A", "since": "", "until": ""}),
    (
        "annotations",
        {"id": ID.format(3), "spacecraft": "XTE", "start": "", "start_ns": 1, "end_ns": 2}
        | {"text": "a note", "who": "A", "created": ""},
    ),
    (
        "webhooks",
        {"id": ID.format(4), "name": "w", "url": "https://x.example/", "enabled": True}
        | {"who": "A", "created": "", "secret": "s", "position": 1},
    ),
    (
        "calibrations",
        {"id": ID.format(6), "spacecraft": "XTE", "version": 1, "run": "live", "created": ""}
        | {"ended": "", "who": "A", "state": "done", "done": 1, "total": 1, "request": "{}"}
        | {"mission_digest": None, "result": "{}"},
    ),
    (
        "calibration_adoptions",
        _ADOPTION | {"id": ID.format(7), "file_digest": None, "mission_digest": None},
    ),
    ("alarms", _ALARM | {"id": ID.format(8)}),
    ("alarm_actions", {"alarm_id": ID.format(8), "at": "", "action": "acknowledge", "who": "A"}),
]
"""Rows of what people do, as the service writes them; `""` stands for a moment."""


def fill(app, make, missions):
    """Record results of every kind and rows of every bound table; bind them into two heads."""
    ids = [
        _patiently(app.submissions.submit, make(f"b{k}", kind=kind, after_s=600.0 * k)).id
        for k, kind in BATCHES.items()
    ]
    (drawn,) = draw_frames(missions["IMAGER"], app.sky, FrameSettings(frames=1, seed=5))
    content = frame_bytes(drawn)
    _patiently(
        lambda: app.part(Pictures).frames.submit(
            "IMAGER", read_known(drawn.known), io.BytesIO(content)
        )
    )
    rates = [(0.0, 0.0, 0.0)] * 3_001
    gyro = GyroBlockIn(block="g1", start=START.text, step_s=1.0, rates_rad_per_s=rates)
    app.gyro.record(block_from_model(gyro, "XTE"))
    app.part(Definitive).days.smooth("XTE")
    app.projector.make_heads()
    app.results.what_if(ids[0], TIGHT, adopt=True)
    app.results.what_if(ids[1], TIGHT, record=True)
    app.store.writer.change(_insert_rows)
    app.projector.make_heads()


def _patiently(submit, *given):
    """What is submitted, also where the machine is at work on other things."""

    def submitted():
        with suppress(Busy):
            return submit(*given)

    return wait_until(submitted, 120.0, why="no processor is free", every_s=0.1)


def _insert_rows(connection):
    mission = connection.scalar(select(tables.missions.c.digest))
    known = {table.name: table for table in all_tables()}
    for name, row in ROWS:
        values = {key: START.text if value == "" else value for key, value in row.items()}
        values |= {key: mission for key, value in row.items() if value is None}
        connection.execute(insert(known[name]).values(values))


@contextmanager
def changing(database):
    """A connection of a person with access, whom no reference between tables holds up."""
    engine = create_engine(database_url(database))
    with engine.begin() as connection:
        if database.startswith("sqlite"):
            # Outside of a transaction: within one it does nothing.
            connection.connection.driver_connection.rollback()
            connection.connection.driver_connection.execute("PRAGMA foreign_keys = OFF")
        else:
            connection.execute(text("SET session_replication_role = replica"))
        yield connection
    engine.dispose()


def rows_in(connection):
    """Every row of every table, in order of the keys."""
    return {
        table.name: rows_of(connection, select(table).order_by(*table.primary_key))
        for table in all_tables()
    }


def digest_anew(connection):
    """Compute every digest and every seal of what is there, as the service does."""
    made = rows_of(connection, select(tables.results))
    ids = [row["id"] for row in made]
    stars = owned_rows(connection, tables.star_results, "result_id", ids)
    owners = ((tables.solutions, "result_id"), (tables.batches, "id"), (tables.frames, "batch_id"))
    others = [owned_rows(connection, table, owner, ids) for table, owner in owners]
    for row in made:
        own = [next(iter(rows[row["id"]]), None) for rows in others]
        digest = digest_of(row, stars[row["id"]], *own)
        change = update(tables.results).where(tables.results.c.id == row["id"])
        connection.execute(change.values(digest=digest))
    for table in (*SETTINGS, tables.tracker_values):
        for row in rows_of(connection, select(table)):
            key = [column == row[column.name] for column in table.primary_key]
            connection.execute(
                update(table).where(*key).values(row_digest=digest_of_row(table, row))
            )
    connection.execute(tables.seals.delete())
    counted = seals._adding(dialect_of(connection).module, tables.results.c.id.is_not(None))
    connection.execute(counted)


def chain_anew(connection, sign=None):
    """Make all leaves, facts and heads anew, as one who knows every algorithm can."""
    for table in (record_heads, record_facts, record_leaves):
        connection.execute(table.delete())
    maker = heads.HeadMaker(sign)
    while maker.make(connection, lock_position(connection)):
        pass


def leaves_anew(connection):
    """Make all leaves and facts anew below the heads that are there."""
    kept = rows_of(connection, select(record_heads).order_by(record_heads.c.number))
    bound = dict(connection.execute(select(record_facts.c.id, record_facts.c.head)).all())
    chain_anew(connection)
    connection.execute(record_heads.delete())
    if kept:
        connection.execute(insert(record_heads), kept)
    last = kept[-1]["number"] if kept else None
    for id in connection.scalars(select(record_facts.c.id)).all():
        change = update(record_facts).where(record_facts.c.id == id)
        connection.execute(change.values(head=bound.get(id, last)))


def heads_of(database):
    """The heads of a record, as somebody keeps them elsewhere."""
    with changing(database) as connection:
        query = select(record_heads.c.number, record_heads.c.sha256).order_by(record_heads.c.number)
        return [verify_chain.Anchor(*row) for row in connection.execute(query)]
