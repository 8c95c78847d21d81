"""A token that is bound to spacecraft sees nothing of others: not that they are there at all."""

import json
import re
from functools import partial
from itertools import islice

import httpx
import pytest

from service import access
from service.app.factory import open_app
from service.settings import Settings
from service.storage.recording.ids import Ulids
from service.times import shifted, utc_now
from service.web.app import create_app
from tests.gyro import blocks
from tests.waiting import wait_until
from tests.web.console_pages import console_addresses
from tests.web.serving import Server

SERVICE_TIME = re.compile(r"20[2-9]\d-\d\d-\d\d( \(\d+\))?[ T][\d:.]+Z?")
VARIES = re.compile(
    r'"(received_age_s|age_s|\w+_us)": ?[\d.e-]+|data-age="\d+">[^<]*|[\d.,\u202f]+[µm]s'
)
"""Ages, and the times that computing took."""
QUERIES = [
    {},
    {"spacecraft": "SWAS"},
    {"run": "mine"},
    {"run": "others"},
    {"run": "others", "spacecraft": "SWAS"},
    {"spacecraft": "XTE"},
]
NDJSON = {"Content-Type": "application/x-ndjson"}
NAMES = {"kind": "batches", "quantity": "ambiguous_share", "slug": "bad-input", "run": "others"}


@pytest.fixture(scope="module")
def served(chosen_database):
    app = open_app(Settings(database=chosen_database(), replay_processes=0))
    ids, now = Ulids(), utc_now()

    def token(name, spacecraft):
        secret = access.new_secret()
        more = {"rate_per_s": None, "created": now.text, "expires": shifted(now, 86400).text}
        add = partial(access.add_token, id=ids.new(), name=name, secret=secret, **more)
        app.context.change(
            lambda connection: add(connection, scopes=access.SCOPES, spacecraft=spacecraft)
        )
        return {"Authorization": f"Bearer {secret}"}

    every, bound = token("every", None), token("bound", ["SWAS"])
    with (
        Server(create_app(app)) as url,
        httpx.Client(base_url=url, timeout=60, headers=every) as client,
        httpx.Client(base_url=url, timeout=60, headers=bound) as reader,
    ):
        yield client, reader


def templates_of(client):
    """Every GET of the description and every page."""
    description = client.get("/api/v1/openapi.json").json()
    found = [path for path, each in description["paths"].items() if "get" in each]
    pages = ["/batches/{id}", "/alarms/{id}", "/replays/{id}", "/spacecraft/SWAS"]
    return [*(path for path in found if not path.endswith("/events")), *console_addresses(), *pages]


def addresses(client):
    """These with the names of SWAS and of another."""
    latest = client.get("/api/v1/batches?spacecraft=SWAS").json()["items"][0]["id"]
    for path in templates_of(client):
        for name in ("SWAS", "XTE") if "{name}" in path else ("SWAS",):
            yield re.sub(
                r"\{(\w+)\}",
                lambda at, name=name: (NAMES | {"name": name, "id": latest})[at[1]],
                path,
            )


def seen(reader, paths):
    answers = {}
    for path in paths:
        for query in QUERIES:
            answer = reader.get(path, params=query)
            body = VARIES.sub("varies", SERVICE_TIME.sub("then", answer.text))
            answers[path, json.dumps(query)] = answer.status_code, body
    return answers


def changes(before, after):
    """The addresses whose answers differ, with the first line that does."""
    found = {}
    for address, (status, body) in after.items():
        if (status, body) != before[address]:
            lines = zip(before[address][1].splitlines(), body.splitlines(), strict=False)
            found[address] = next((each for each in lines if each[0] != each[1]), status)
    return found


def beginning(reader, after):
    """What a stream of events begins with, up to the number that it tells to be the latest."""
    with reader.stream("GET", "/api/v1/events", params=after) as answer:
        assert answer.status_code == 200
        return list(islice(answer.iter_lines(), 4))


def of_others(client, drawn):
    """All kinds of things about XTE, and their ids by what comes before {id} in an address."""
    tight = {"settings": {"watch": {"high": 1e-9}, "minimum_count": 1, "duration_s": 0}}
    place = "/api/v1/spacecraft/XTE"
    client.put(f"{place}/limits/residual_rms_arcsec", json=tight).raise_for_status()
    ids = {}
    for run, batch in zip(("live", "others", "mine"), drawn("XTE", 3), strict=True):
        later = batch | {"run": run, "time": "1999-09-09T00:00:00.000Z"}
        answer = client.post("/api/v1/batches", json=later)
        assert answer.status_code == 201
        ids["batches"] = answer.json()["id"]
    note = {"text": "a secret of XTE", "start": "1999-03-01T00:00:00Z", "spacecraft": "XTE"}
    assert client.post("/api/v1/annotations", json=note).status_code == 201
    ids["gyro"] = client.post(f"{place}/gyro", json=blocks.body()).raise_for_status().json()["id"]
    lines = json.dumps(drawn("XTE", 1)[0] | {"batch": "replayed"})
    # Its id is told to nobody else, and to know it is to follow the replay: see docs/access.md.
    begun = client.post("/api/v1/replays?run=others", content=lines, headers=NDJSON)
    place = begun.raise_for_status().headers["Location"]
    wait_until(lambda: client.get(place).json()["state"] == "done")
    found = client.get("/api/v1/alarms", params={"spacecraft": "XTE"}).json()["items"]
    ids["alarms"] = found[0]["id"]
    return ids


def test_what_a_bound_token_is_answered_does_not_change_with_what_comes_of_others(served, drawn):
    client, reader = served
    for run, batch in zip(("live", "live", "mine"), drawn("SWAS", 3), strict=True):
        assert client.post("/api/v1/batches", json=batch | {"run": run}).status_code == 201
    paths = sorted(set(addresses(client)))
    before = seen(reader, paths)
    streams = [{"spacecraft": "SWAS"}, {"spacecraft": "SWAS", "last_event_id": 0}]
    begun = [beginning(reader, each) for each in streams]
    ids = of_others(client, drawn)
    after = seen(reader, paths)
    found = changes(before, after)
    assert not found, "\n".join(f"{each}: {lines}" for each, lines in found.items())
    assert [beginning(reader, each) for each in streams] == begun
    assert not [each for each, (_, body) in after.items() if "a secret of XTE" in body]
    # An id of another's is answered as one that was never given.
    templates = [each for each in templates_of(client) if "{id}" in each]
    named = {kind for each in templates for kind in ids if f"/{kind}/" in each}
    assert named == ids.keys()
    for template in templates:
        kind = next((each for each in ids if f"/{each}/" in template), None)
        if kind is not None:
            path = template.replace("{name}", "XTE")
            answers = [
                seen(reader, [path.replace("{id}", id)]).values() for id in (ids[kind], "0" * 26)
            ]
            told = [
                [(status, body.replace(id, "an id")) for status, body in each]
                for each, id in zip(answers, (ids[kind], "0" * 26), strict=True)
            ]
            assert told[0] == told[1], template
