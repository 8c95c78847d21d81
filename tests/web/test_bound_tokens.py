"""A token that is bound to spacecraft sees nothing of others: not that they are there at all."""

import json
import re
from functools import partial

import httpx
import pytest

from service.access import tokens
from service.app.factory import open_app
from service.settings import Settings
from service.storage.recording.ids import Ulids
from service.times import shifted, utc_now
from service.web.app import create_app
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
NAMES = {"kind": "batches", "quantity": "ambiguous_share", "slug": "bad-input", "run": "others"}


@pytest.fixture(scope="module")
def served(chosen_database):
    app = open_app(Settings(database=chosen_database(), replay_processes=0))
    ids, now = Ulids(), utc_now()

    def token(name, spacecraft):
        secret = tokens.new_secret()
        more = {"rate_per_s": None, "created": now.text, "expires": shifted(now, 86400).text}
        add = partial(tokens.add_token, id=ids.new(), name=name, secret=secret, **more)
        app.context.change(
            lambda connection: add(connection, scopes=tokens.SCOPES, spacecraft=spacecraft)
        )
        return {"Authorization": f"Bearer {secret}"}

    every, bound = token("every", None), token("bound", ["SWAS"])
    with (
        Server(create_app(app)) as url,
        httpx.Client(base_url=url, timeout=60, headers=every) as client,
        httpx.Client(base_url=url, timeout=60, headers=bound) as reader,
    ):
        yield client, reader


def addresses(client):
    """Every GET of the description and every page, with the names of SWAS and of another."""
    description = client.get("/api/v1/openapi.json").json()
    found = [path for path, each in description["paths"].items() if "get" in each]
    found = [path for path in found if not path.endswith("/events")]
    latest = client.get("/api/v1/batches?spacecraft=SWAS").json()["items"][0]["id"]
    paths = [*found, *console_addresses(), "/batches/{id}", "/spacecraft/SWAS"]
    for path in paths:
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


def test_what_a_bound_token_is_answered_does_not_change_with_batches_of_others(served, drawn):
    client, reader = served
    for run, batch in zip(("live", "live", "mine"), drawn("SWAS", 3), strict=True):
        assert client.post("/api/v1/batches", json=batch | {"run": run}).status_code == 201
    paths = sorted(set(addresses(client)))
    before = seen(reader, paths)
    for run, batch in zip(("live", "others", "mine"), drawn("XTE", 3), strict=True):
        later = batch | {"run": run, "time": "1999-09-09T00:00:00.000Z"}
        assert client.post("/api/v1/batches", json=later).status_code == 201
    note = {"text": "a secret of XTE", "start": "1999-03-01T00:00:00Z", "spacecraft": "XTE"}
    assert client.post("/api/v1/annotations", json=note).status_code == 201
    limit = client.get("/api/v1/spacecraft/XTE/limits").json()
    assert limit["items"]
    after = seen(reader, paths)
    found = changes(before, after)
    assert not found, "\n".join(f"{each}: {lines}" for each, lines in found.items())
    assert not [each for each, (_, body) in after.items() if "a secret of XTE" in body]
