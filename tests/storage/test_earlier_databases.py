"""Databases that earlier commits wrote are brought up to date, and all that they hold is read.

Those of tests/databases with a schema that the migrations know, on SQLite and on PostgreSQL; its
README says how they were made.  Every route that reads and every page is found
in the interface's description and in the app, so that new ones are read as well.
"""

import json
import re
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import httpx
import pytest
from sqlalchemy import MetaData, create_engine, inspect, select
from sqlalchemy.pool import NullPool

from service.access import add_token, new_secret
from service.app.factory import open_app
from service.settings import Settings
from service.storage.sql import migrations
from service.storage.sql.columns import unpack
from service.storage.sql.engines import database_url
from service.storage.upkeep.verify import earlier_results, verify
from service.trends.quantities import trend_names
from service.web.app import create_app
from service.web.requests.problems import types_with_pages
from tests.databases.make import FOLDER, restore
from tests.scale import some_in_a_sitting
from tests.waiting import wait_until
from tests.web.conformance import check, reference
from tests.web.serving import Server

pytestmark = pytest.mark.both_databases

API = "/api/v1"
REVISIONS = [each for each in migrations.REVISIONS if Path(FOLDER, f"{each}.sqlite.gz").is_file()]
KINDS = ("sqlite", "postgresql")
LIVE_STREAM = f"{API}/events"
"""It does not end: its beginning is read by a test of its own."""
WITHOUT_A_RUN = ("/sign-in",)
FOR_PROBES = ("/livez", "/readyz", "/metrics")
COMPARED = (
    "columns",
    "primary key",
    "foreign keys",
    "unique constraints",
    "indexes",
    "check constraints",
)


@dataclass(frozen=True)
class Earlier:
    """An earlier database that was brought up to date and is served.

    `before` and `after` are its rows by table around the upgrade, `problems`
    what `verify` said then.
    """

    url: str
    before: dict
    after: dict
    schema: dict
    problems: list
    client: httpx.Client
    app: object

    def get(self, address, **wanted):
        answer = self.client.get(address, **wanted)
        assert answer.status_code == 200, (address, answer.status_code, answer.text[:500])
        return answer

    def every_row(self, address):
        """The items of all pages of a list."""
        while address:
            answer = self.get(address)
            yield from answer.json()["items"]
            address = answer.links.get("next", {}).get("url")


@pytest.fixture(scope="module", params=KINDS)
def new_database(request, tmp_path_factory, postgresql_schema):
    """Makes URLs of empty databases, as contexts."""
    if request.param == "postgresql":
        return postgresql_schema

    def sqlite():
        return nullcontext(f"sqlite:///{tmp_path_factory.mktemp('earlier') / 'acquire.db'}")

    return sqlite


@pytest.fixture(scope="session")
def new_schemas():
    """By kind of database, once one was made: a new one takes seconds."""
    return {}


@pytest.fixture(scope="module", params=some_in_a_sitting(REVISIONS))
def earlier(request, new_database):
    revision = request.param
    with new_database() as url:
        restore(revision, url)
        before = rows_of(url)
        assert before["alembic_version"] == [{"version_num": revision}]
        migrations.upgrade(url)
        after, schema, problems = rows_of(url), schema_of(url), verify(url)
        opened = open_app(Settings(database=url, replay_processes=0))
        headers = {"Authorization": f"Bearer {_token(opened)}"}
        app = create_app(opened)
        # As where the service is started by its command.
        opened.upgrade.start()
        hooks = {"response": [check]}
        with (
            Server(app) as address,
            httpx.Client(
                base_url=address, timeout=60, headers=headers, event_hooks=hooks
            ) as client,
        ):
            wait_until(lambda: client.get("/readyz").status_code == 200, why="it is not ready")
            yield Earlier(url, before, after, schema, problems, client, app)
        assert verify(url) == []


def _token(opened):
    """Some of the databases hold tokens, so that access is closed: one more, for the tests."""
    secret = new_secret()
    token = {
        "id": "01JD0000000000000000000001",
        "name": "test",
        "scopes": ("read", "submit", "operate"),
        "spacecraft": None,
        "rate_per_s": None,
        "created": "1999-03-01T12:00:00.000Z",
        "expires": "2099-03-01T12:00:00.000Z",
    }
    opened.context.change(partial(add_token, secret=secret, **token))
    return secret


def rows_of(url):
    engine = create_engine(database_url(url), poolclass=NullPool)
    tables = MetaData()
    tables.reflect(engine)
    with engine.connect() as connection:
        found = {
            table.name: [dict(row) for row in connection.execute(select(table)).mappings()]
            for table in tables.tables.values()
        }
    engine.dispose()
    return found


def schema_of(url):
    """Everything that the database says of its tables, by table and kind; order does not count."""
    engine = create_engine(database_url(url), poolclass=NullPool)
    with engine.connect() as connection:
        seen = inspect(connection)
        told = (
            seen.get_multi_columns(),
            {key: [one] for key, one in seen.get_multi_pk_constraint().items()},
            seen.get_multi_foreign_keys(),
            seen.get_multi_unique_constraints(),
            seen.get_multi_indexes(),
            seen.get_multi_check_constraints(),
        )
    engine.dispose()
    return {
        (table, kind): sorted(_as_text(entry) for entry in entries)
        for kind, by_table in zip(COMPARED, told, strict=True)
        for (_, table), entries in by_table.items()
    }


def _as_text(entry):
    # The schema that this test has for itself stands in defaults that count up.
    return re.sub(r"test_[0-9a-f]{32}\.", "", json.dumps(_plain(entry), sort_keys=True))


def _plain(value):
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value if isinstance(value, bool | int | None) else str(value)


# ---- the upgrade ---------------------------------------------------------------------------------


def test_each_earlier_schema_has_its_databases():
    """See tests/databases/README.md: it is made before the next migration is."""
    assert {*migrations.REVISIONS} - {migrations.HEAD} <= {*REVISIONS}
    files, dumps = (
        {file.name.partition(".")[0] for file in FOLDER.glob(f"*.{kind}.gz")}
        for kind in ("sqlite", "postgresql.sql")
    )
    assert dumps == files


def test_the_upgrade_loses_nothing(earlier):
    for name, rows in earlier.before.items():
        if name == "alembic_version" or not rows:
            continue
        shown = [{column: row[column] for column in rows[0]} for row in earlier.after[name]]
        assert sorted(map(repr, shown)) == sorted(map(repr, rows)), name
    assert earlier.before["batches"]
    assert earlier.before["star_results"]
    assert any(row["parent_id"] for row in earlier.before["results"])


def test_its_schema_is_that_of_a_new_database(earlier, new_schemas, new_database):
    kind = earlier.url.partition(":")[0]
    if kind not in new_schemas:
        with new_database() as url:
            migrations.upgrade(url)
            new_schemas[kind] = schema_of(url)
    assert earlier.schema == new_schemas[kind]
    assert migrations.check(earlier.url) == []


def test_verify_finds_nothing_wrong(earlier):
    assert earlier.problems == []


def test_its_results_get_digests_that_are_marked_as_made_later(earlier):
    """Beside the service, which makes them after its start; what changed since then is found."""
    wait_until(lambda: earlier_results(earlier.url)[0] == 0, why="some have no digest")
    ids = {row["id"] for row in earlier.before["results"] if row.get("digest") is None}
    made = {row["id"]: row["digest"] for row in rows_of(earlier.url)["results"]}
    assert all(made[id] < 0 for id in ids)
    assert verify(earlier.url) == []


# ---- reading -------------------------------------------------------------------------------------


def names_of(earlier):
    """What may stand in an address in place of {name}, {run}, and so on, by what comes before."""
    spacecraft = [each["name"] for each in earlier.get(f"{API}/spacecraft").json()["items"]]
    runs = [each["run"] for each in earlier.get(f"{API}/runs").json()["items"]]
    alarms = [
        each["id"]
        for run in runs
        for each in earlier.every_row(f"{API}/alarms?run={run}&state=all")
    ]
    return {
        "batches/{id}": [each["id"] for each in earlier.every_row(f"{API}/batches?run=*")],
        "replays/{id}": [each["id"] for each in earlier.get(f"{API}/replays").json()["items"]],
        "alarms/{id}": alarms,
        "webhooks/{id}": [e["id"] for e in earlier.get(f"{API}/webhooks").json()["items"]],
        "spacecraft/{name}": spacecraft,
        "advice/{name}": spacecraft,
        "latest/{name}": spacecraft,
        "runs/{run}": runs,
        "tables/{kind}": ["batches", "stars", "gyro"],
        # Of none is anything kept: earlier versions took no gyro, and jobs end with their service.
        "gyro/{id}": [],
        "definitive-attitude/{id}": [],
        "calibrations/{id}": [
            each["id"] for each in earlier.get(f"{API}/calibrations").json()["items"]
        ],
        "problems/{slug}": list(types_with_pages()),
        "limits/{quantity}": [
            each["quantity"] for each in earlier.get(f"{API}/spacecraft/XTE/limits").json()["items"]
        ],
    }


def filled(template, names):
    """Every address of a path with parameters."""
    found = re.search(r"([\w-]+)/\{(\w+)\}", template)
    if not found:
        return [template]
    assert found[0] in names, f"{template}: tell the test what stands for {found[0]}"
    return [
        address
        for name in names[found[0]]
        for address in filled(template.replace(found[0], f"{found[1]}/{name}", 1), names)
    ]


def queries(address, runs):
    """What is asked beside the address alone; `runs` are those that its spacecraft has."""
    by_run = [f"?run={run}" for run in runs]
    rest = address.rpartition("/")[2]
    if rest == "history":
        every = "&".join(f"quantity={name}" for name in trend_names())
        return [
            f"{each}&{more}"
            for each in by_run
            for more in (f"{every}&size=50", "strategy=latest&size=50", "format=csv")
        ]
    if rest == "rates":
        return [f"{each}&bucket={bucket}" for each in by_run for bucket in ("hour", "day")]
    if rest == "advice":
        return ["?sample=4"]
    if "/tables/" in address:
        return by_run
    if rest == "batches":
        shown = ("outcome=ambiguous", "outcome=unmatched", "status=good", "status=suspect")
        return by_run + [f"?run=*&{each}" for each in shown]
    by_run_alone = ("spacecraft", "overview", "attitudes", "attitude", "worst", "latest", "gyro")
    return by_run if rest in by_run_alone else [""]


def runs_of(earlier, address):
    """The runs that hold batches of the spacecraft that an address names, else all."""
    named = re.search(r"/spacecraft/([^/]+)", address)
    rows = earlier.before["batches"]
    return {row["run"] for row in rows if not named or row["spacecraft"] == named[1]}


@pytest.mark.slow("postgresql")
def test_every_route_that_reads_answers(earlier):
    """Each answer is held against openapi.yaml by the client: later fields have their defaults."""
    names = names_of(earlier)
    for path, methods in reference()["paths"].items():
        if "get" not in methods or path == LIVE_STREAM:
            continue
        if path.endswith(("/overlay", "/attitude/at", "/attitude/latest")):
            continue
        for address in filled(path, names):
            for query in queries(address, runs_of(earlier, address)):
                earlier.get(address + query)
    assert all(names[each] for each in ("batches/{id}", "replays/{id}", "spacecraft/{name}"))


def test_the_attitude_at_a_moment_is_the_recorded_one(earlier):
    for spacecraft in ("XTE", "SOHO"):
        here = f"{API}/spacecraft/{spacecraft}"
        for run in runs_of(earlier, f"{here}/"):
            for each in earlier.get(f"{here}/attitudes?run={run}&limit=5").json()["items"]:
                asked = f"run={run}&time={each['time']}&status=all"
                found = earlier.get(f"{here}/attitude/at?{asked}").json()
                assert found["motion_arcsec"] == 0.0
                assert found["offset_s"] == 0.0


def test_events_of_before_are_sent(earlier):
    # Without the check of the other answers, which would read the stream to its end.
    address = earlier.client.base_url.join(f"{LIVE_STREAM}?last_event_id=0")
    with httpx.stream("GET", address, headers=earlier.client.headers, timeout=10) as answer:
        assert answer.status_code == 200
        names = (line for line in answer.iter_lines() if line.startswith("event: "))
        expected = "batches" if earlier.before.get("events") else "hello"
        assert any(line == f"event: {expected}" for line in islice(names, 3))


@pytest.mark.slow("postgresql")
def test_every_page_is_shown(earlier):
    names = names_of(earlier)
    # Of batches that are alike a few pages stand for all: each takes some 30 ms.
    names["batches/{id}"] = names["batches/{id}"][::8] + framed(earlier)
    names["advice/{name}"] = ["XTE?sample=4"]
    pages = {
        route.path
        for route in earlier.app.state.routes
        if "GET" in route.methods and not route.path.startswith("/api/")
    } - {*FOR_PROBES}
    assert len(pages) >= 16
    for path in sorted(pages):
        for address in filled(path, names):
            answer = earlier.get(address, follow_redirects=True)
            assert answer.headers["content-type"].startswith("text/html"), address
        if "{" not in path and path not in WITHOUT_A_RUN:
            earlier.get(f"{path}?run=replayed")
    earlier.get("/compare?spacecraft=XTE&sample=3")


def framed(earlier):
    return [each["id"] for each in earlier.every_row(f"{API}/batches?run=*&spacecraft=IMAGER")]


def test_frames_are_drawn(earlier):
    made = framed(earlier)
    assert len(made) == len(earlier.before.get("frames", []))
    for id in made:
        answer = earlier.get(f"{API}/batches/{id}/overlay")
        assert answer.content.startswith(b"\x89PNG")


def test_the_same_batch_again_is_answered_with_the_bytes_of_its_day(earlier):
    """The fingerprint of a body must not depend on the version that computed it."""
    first = {row["batch_id"]: row for row in earlier.before["results"] if not row["parent_id"]}
    frames = {row["batch_id"] for row in earlier.before.get("frames", [])}
    asked = [row for row in earlier.before["batches"] if row["id"] not in frames]
    assert asked
    for row in asked:
        headers = {"Content-Type": "application/json"}
        sent = unpack(row["input"])
        answer = earlier.client.post(f"{API}/batches", content=sent, headers=headers)
        assert answer.status_code == 200, (row["batch"], answer.text[:300])
        assert answer.headers["Replayed"] == "true"
        assert answer.text == unpack(first[row["id"]]["answer"])


def test_it_takes_new_batches_and_what_ifs(earlier):
    row = next(row for row in earlier.before["batches"] if row["spacecraft"] == "XTE")
    body = json.loads(unpack(row["input"])) | {"batch": "new", "run": "new"}
    assert earlier.client.post(f"{API}/batches", json=body).status_code == 201
    asked = {"options": {"solver": "triad"}, "record": True}
    answer = earlier.client.post(f"{API}/batches/{row['id']}/what-if", json=asked)
    assert answer.status_code == 201, answer.text[:300]
