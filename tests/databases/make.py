"""Makes the databases of a schema that `tests/storage/test_earlier_databases.py` upgrades.

    python -m tests.databases.make               of this tree
    python -m tests.databases.make --tree PATH   of another checkout

Writes REVISION.sqlite.gz and REVISION.postgresql.sql.gz beside this file.  Run it
after a migration was added, before the first commit that has the migration's code,
in a checkout of the commit before: the database must be written by code that does
not know of the migration.  README.md says how the present ones were made.

The service of the tree is started over an empty database and is sent batches,
replays, limits and frames over HTTP, as far as it knows of them; the server on
TEST_POSTGRESQL_URL must let its user create databases, and pg_dump must be there.
"""

import argparse
import gzip
import json
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import Connection, create_engine, make_url, text
from sqlalchemy.pool import NullPool
from tqdm import tqdm

from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.missions.mission import load_missions
from service.simulate.stretches import Pass, Trouble, Troubles
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

FOLDER = Path(__file__).resolve().parent
TREE = FOLDER.parents[1]
API = "/api/v1"
START_S = 600.0
FRAMED = "IMAGER"
"""The only spacecraft that sends frames."""
ROWS_AT_ONCE = 50
SAID = {"who": "J. Operator", "comment": "one star in view"}
Json = dict[str, Any]


def sqlite_file(revision: str) -> Path:
    return FOLDER / f"{revision}.sqlite.gz"


def postgresql_file(revision: str) -> Path:
    return FOLDER / f"{revision}.postgresql.sql.gz"


# ---- what is recorded ----------------------------------------------------------------------------


def record(client: httpx.Client, new_token: Callable[[], str]) -> None:
    """Send what a mission sends in some hours, as far as the server knows of it."""
    known = client.get("/api/v1/openapi.json").json()["paths"]
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    missions = load_missions()
    trouble = Troubles(Trouble(0.2), Trouble(0.2, 2), Trouble(0.0), Trouble(0.2, 12.0))

    def drawn(name: str, batches: int, **wanted: Any) -> list[Json]:
        asked = Pass(batches=batches, **({"troubles": trouble, "cadence_s": 1200.0} | wanted))
        return [each.batch for each in draw_pass(missions[name], sky, asked)]

    def submit(body: Json, **headers: str) -> Json:
        answer = client.post(f"{API}/batches", json=body, headers=headers)
        assert answer.status_code < 500, answer.text
        return answer.json()

    xte = drawn("XTE", 10)
    for k, body in enumerate(xte):
        submit(body, **({"Idempotency-Key": f"key-{k}"} if k < 3 else {}))
    for k, body in enumerate(drawn("SOHO", 6, prior="mixed")):
        submit(body | {"options": {"identifier": "starid"} if k % 2 else {}})
    for body in drawn("SWAS", 4, stars=1):
        submit(body)
    # By votes about a direction alone the two stars of a pair are not told apart.
    for body in drawn("XTE", 3, stars=2, prior="direction", start="1999-03-04T00:00:00.000Z"):
        submit(body | {"options": {"identifier": "starid"}})
    for k, body in enumerate(drawn("SWAS", 3, stars=12, start="1999-03-02T00:00:00.000Z")):
        # Lost in space; earlier services refuse it.
        submit(body | {"a_priori": None, "batch": f"lost-{k}"})
    submit(xte[0] | {"batch": "bad", "time": "noon"})
    submit(xte[0] | {"batch": "mirrored", "observations": [_mirrored(xte[0]["observations"][0])]})
    submit(xte[1] | {"run": "named", "batch": "of a run"})

    first = submit(xte[0])
    what_if = f"{API}/batches/{first['id']}/what-if"
    for body in (
        {"options": {"solver": "triad"}, "record": True},
        {
            "options": {"identifier": "starid", "tolerances": {"separation_deg": 0.02}},
            "adopt": True,
        },
    ):
        client.post(what_if, json=body).raise_for_status()

    lines = [json.dumps(body | {"batch": f"line-{k}"}) for k, body in enumerate(drawn("SWAS", 8))]
    file = "\n".join([*lines, '{"batch": 3}', lines[0][:40]])
    _replayed(client, "replayed", file)
    if f"{API}/alarms" in known:
        _alarm(client, drawn("SWAS", 4, stars=1, start="1999-03-03T00:00:00.000Z"))
    if f"{API}/spacecraft/{{name}}/frames" in known:
        (frame,) = draw_frames(missions[FRAMED], sky, FrameSettings(frames=1))
        query = {
            name: value if isinstance(value, str) else json.dumps(value)
            for name, value in frame.known.items()
        }
        headers = {"Content-Type": "application/fits"}
        path = f"{API}/spacecraft/{FRAMED}/frames"
        client.post(
            path, params=query, content=frame_bytes(frame), headers=headers
        ).raise_for_status()
    if f"{API}/calibrations" in known:
        _calibrate(client)
    if f"{API}/session" in known:
        token = new_token()
        # What is known of tokens is believed for a second.
        time.sleep(1.5)
        client.post(f"{API}/session", json={"token": token}).raise_for_status()


def _mirrored(observed: Json) -> Json:
    """No rotation takes the sky to these stars: none is found."""
    stars = [
        star | ({"vector": [-star["vector"][0], *star["vector"][1:]]} if "vector" in star else {})
        for star in observed["stars"]
    ]
    return observed | {"stars": stars}


def _replayed(client: httpx.Client, run: str, file: str) -> None:
    headers = {"Content-Type": "application/x-ndjson"}
    begun = client.post(f"{API}/replays?run={run}", content=file, headers=headers)
    begun.raise_for_status()
    while client.get(begun.headers["Location"]).json()["state"] == "running":
        time.sleep(0.1)


def _alarm(client: httpx.Client, lone: list[Json]) -> None:
    """A changed limit, a watched run, and an alarm that is shelved, commented, acknowledged."""
    limit = f"{API}/spacecraft/SWAS/limits/no_attitude_share"
    settings = {"warning": {"high": 0.5}, "minimum_count": 2, "duration_s": 0}
    client.put(limit, json={"settings": settings, **SAID}).raise_for_status()
    client.put(f"{API}/runs/watched", json={"alarms": True}).raise_for_status()
    for k, body in enumerate(lone):
        body |= {"run": "watched", "batch": f"watched-{k}"}
        client.post(f"{API}/batches", json=body).raise_for_status()
    found = client.get(f"{API}/alarms?run=watched&state=all").json()["items"]
    alarm = f"{API}/alarms/{found[0]['id']}"
    for act, more in (
        ("shelve", {"minutes": 60}),
        ("unshelve", {}),
        ("comment", {}),
        ("acknowledge", {}),
    ):
        client.post(f"{alarm}/{act}", json=SAID | more).raise_for_status()
    client.delete(f"{limit}?who=J.%20Operator").raise_for_status()


def _calibrate(client: httpx.Client) -> None:
    """A calibration that is adopted, and one without a star to calibrate with."""
    signed = {"who": SAID["who"]}
    asked = {"spacecraft": "XTE", "degree": 0, **signed}
    for run, state in (("live", "done"), ("none", "failed")):
        begun = client.post(f"{API}/calibrations", json=asked | {"run": run})
        begun.raise_for_status()
        location = begun.headers["Location"]
        while (found := client.get(location).json()["state"]) in ("queued", "running"):
            time.sleep(0.1)
        assert found == state, (run, found)
        if state == "done":
            client.post(f"{location}/adopt", json=signed | {"note": "first"}).raise_for_status()


# ---- the code of a tree --------------------------------------------------------------------------


def run_and_record(tree: Path, database: str) -> None:
    """Serve the tree over a database, and have everything recorded."""
    _acquire(tree, "database", "upgrade", "--database", database)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    arguments = ["serve", "--port", str(port), "--database", database]
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", *arguments], cwd=tree, stderr=subprocess.DEVNULL
    )

    def new_token() -> str:
        scopes = ["--scope", "read", "--scope", "operate", "--days", "30"]
        printed = _acquire(tree, "token", "create", "J. Operator", *scopes, "--database", database)
        return next(word for word in printed.split() if word.startswith("acq_"))

    try:
        address = f"http://127.0.0.1:{port}"
        with httpx.Client(base_url=address, timeout=START_S) as client:
            _await_ready(client, process)
            record(client, new_token)
    finally:
        process.terminate()
        process.wait()


def _acquire(tree: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", *arguments],
        cwd=tree,
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout


def _await_ready(client: httpx.Client, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise SystemExit("the server has ended")
        try:
            if client.get("/readyz").status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    raise SystemExit("the server did not become ready")


# ---- files ---------------------------------------------------------------------------------------


def keep_sqlite(database: Path) -> str:
    """Write the fixture of a SQLite file; its revision."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder, "whole.db")
        with sqlite3.connect(database) as connection:
            connection.execute("VACUUM INTO ?", (str(whole),))
            (revision,) = connection.execute("SELECT version_num FROM alembic_version").fetchone()
        sqlite_file(revision).write_bytes(gzip.compress(whole.read_bytes(), mtime=0))
    return str(revision)


def keep_postgresql(database: str, revision: str) -> None:
    """Write the fixture of a PostgreSQL database: a dump that needs no psql to be read."""
    url = make_url(database).set(drivername="postgresql")
    options = ["--no-owner", "--no-privileges", "--inserts", f"--rows-per-insert={ROWS_AT_ONCE}"]
    dump = subprocess.run(
        ["pg_dump", *options, url.render_as_string(hide_password=False)],
        check=True,
        capture_output=True,
    ).stdout
    postgresql_file(revision).write_bytes(gzip.compress(dump, mtime=0))


@contextmanager
def postgresql_database() -> Iterator[str]:
    """A new database beside the one that TEST_POSTGRESQL_URL names."""
    server = make_url(os.environ["TEST_POSTGRESQL_URL"])
    name = f"made_{uuid.uuid4().hex[:12]}"
    engine = create_engine(server, isolation_level="AUTOCOMMIT", poolclass=NullPool)
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    try:
        yield server.set(database=name).render_as_string(hide_password=False)
    finally:
        with engine.connect() as connection:
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))


def restore_sqlite(revision: str, file: Path) -> None:
    """Put a fixture back as a file."""
    with gzip.open(sqlite_file(revision)) as packed, file.open("wb") as out:
        shutil.copyfileobj(packed, out)


def restore_postgresql(revision: str, connection: Connection, schema: str) -> None:
    """Run a fixture's dump in a schema, in place of the one that it was taken from."""
    dump = gzip.decompress(postgresql_file(revision).read_bytes()).decode()
    dump = dump.replace("public.", f"{schema}.")
    # Lines with a backslash are for psql alone.
    dump = "\n".join(line for line in dump.splitlines() if not line.startswith("\\"))
    with connection.connection.cursor() as cursor:
        cursor.execute(dump.encode())


def restore(revision: str, database: str) -> None:
    """Put a fixture back into an empty database, of the kind that the URL names."""
    url = make_url(database)
    if url.drivername == "sqlite":
        restore_sqlite(revision, Path(url.database or ""))
        return
    engine = create_engine(url, poolclass=NullPool)
    with engine.begin() as connection:
        schema = connection.scalar(text("SELECT current_schema()"))
        restore_postgresql(revision, connection, schema)
    engine.dispose()


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.databases.make",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--tree", type=Path, default=TREE, help="the checkout to run")
    tree = parser.parse_args().tree.resolve()
    with tempfile.TemporaryDirectory() as folder, postgresql_database() as postgresql:
        file = Path(folder, "made.db")
        targets = (f"sqlite:///{file}", postgresql)
        for target in tqdm(targets, desc="recording", unit="database"):
            run_and_record(tree, target)
        revision = keep_sqlite(file)
        keep_postgresql(postgresql, revision)
    for each in (sqlite_file(revision), postgresql_file(revision)):
        print(f"{each.relative_to(TREE)}: {each.stat().st_size} bytes")


if __name__ == "__main__":
    main()
