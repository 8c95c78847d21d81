"""The examples of `openapi.yaml`, taken from a real run: `python -m tests.web.examples`.

They are written to `service/web/examples.json`; `make openapi` then puts them
into `openapi.yaml`.
"""

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx

from service.missions.mission import load_missions
from service.operations import Operations
from service.settings import Settings
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.web.app import create_app
from tests.web.conftest import Server

FILE = Path(__file__).parents[2] / "service" / "web" / "examples.json"
API = "/api/v1"
Json = dict[str, Any]


def walk(client: httpx.Client, operations: Operations) -> Json:
    """Requests and answers by operation and status, of a walk through every route."""
    found: Json = {}

    def take(operation: str, answer: httpx.Response, name: str, asked: Json | None = None) -> Json:
        entry = found.setdefault(operation, {})
        if asked is not None:
            entry.setdefault("request", {})[name] = asked
        content: Json = answer.json()
        entry.setdefault(str(answer.status_code), {})[name] = content
        return content

    def submit(name: str, body: Json, **headers: str) -> Json:
        answer = client.post(f"{API}/batches", json=body, headers=headers)
        return take("submit_batch", answer, name, body if answer.status_code == 201 else None)

    xte = _drawn(operations, "XTE", stars=3)
    first = submit("attitude", xte, **{"Idempotency-Key": "1999-060-0001"})
    lone = xte["observations"][0] | {"stars": xte["observations"][0]["stars"][:1]}
    submit("no_attitude", xte | {"batch": "1999-060-0002", "observations": [lone]})
    submit("direction_only", _drawn(operations, "SWAS", stars=3, prior="direction"))
    submit("sun_pointed", _drawn(operations, "SOHO", stars=3, prior="direction"))
    other = xte | {"aberration": "ignore"}
    submit("another_body", other)
    submit("key_of_another_body", other, **{"Idempotency-Key": "1999-060-0001"})
    submit("unknown_spacecraft", xte | {"spacecraft": "NOPE"})
    submit("faults", xte | {"time": "noon", "aberration": "maybe", "colour": "red"})
    headers = {"Content-Type": "application/json"}
    truncated = client.post(f"{API}/batches", content=b'{"spacecraft": "XTE"', headers=headers)
    take("submit_batch", truncated, "truncated")
    take("submit_batch", client.post(f"{API}/batches", content=b"{}"), "no_content_type")

    here = f"{API}/batches/{first['id']}"
    asked = {"options": {"tolerances": {"separation_deg": 0.02}}}
    take("what_if", client.post(f"{here}/what-if", json=asked), "not_recorded", asked)
    asked = {"options": {"solver": "triad"}, "adopt": True}
    take("what_if", client.post(f"{here}/what-if", json=asked), "adopted", asked)
    take("get_batch", client.get(here), "superseded")
    take("list_batches", client.get(f"{API}/batches?spacecraft=XTE&limit=1"), "first_page")
    take("list_batches", client.get(f"{API}/batches?limit=ten"), "limit")

    take("list_spacecraft", client.get(f"{API}/spacecraft"), "all")
    take("get_spacecraft", client.get(f"{API}/spacecraft/SOHO"), "soho")
    take("get_spacecraft", client.get(f"{API}/spacecraft/NOPE"), "unknown")
    take("list_attitudes", client.get(f"{API}/spacecraft/SWAS/attitudes"), "one")
    take("list_rates", client.get(f"{API}/spacecraft/XTE/rates"), "one_hour")

    asked = {"spacecraft": "XTE", "time": xte["time"], "a_priori": [xte["a_priori"]]}
    take("warm_zones", client.post(f"{API}/zones", json=asked), "one", asked)
    take("list_zones", client.get(f"{API}/zones"), "cache")
    take("drop_zones", client.delete(f"{API}/zones?spacecraft=SOHO"), "of_soho")

    content = json.dumps(xte) + '\n{"truncated\n'
    headers = {"Content-Type": "application/x-ndjson"}
    begun = client.post(f"{API}/replays?run=pass-7", content=content, headers=headers)
    take("start_replay", begun, "begun")
    while client.get(begun.headers["Location"]).json()["state"] == "running":
        time.sleep(0.05)
    take("get_replay", client.get(begun.headers["Location"]), "done_with_a_bad_line")
    take("list_runs", client.get(f"{API}/runs"), "two")
    return found


def _drawn(operations: Operations, spacecraft: str, **wanted: Any) -> Json:
    wanted_pass = Pass(batches=1, troubles=NO_TROUBLES, angles_share=0.0, **wanted)
    (drawn,) = draw_pass(load_missions()[spacecraft], operations.sky, wanted_pass)
    return drawn.batch


def fresh_walk() -> Json:
    """The walk through a server of its own with an empty database."""
    with tempfile.TemporaryDirectory() as folder:
        operations = Operations.open(Settings(database=f"sqlite:///{folder}/acquire.db"))
        with (
            Server(create_app(operations)) as address,
            httpx.Client(base_url=address, timeout=60) as client,
        ):
            return walk(client, operations)


if __name__ == "__main__":
    FILE.write_text(json.dumps(fresh_walk(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
