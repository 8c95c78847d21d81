"""Examples in the OpenAPI document, taken from a run of the service.

`python -m service.web.examples` starts a service over an empty database, and sends it the requests
of this module, of the decorators `Example` and of the modules `examples` of features.  It writes
the answers to `examples.json` of `service/web`, and of each feature for its own routes;
`make openapi` then puts them into `openapi.yaml`.
"""

import argparse
import gzip
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any

import httpx

from service.acquire.prewarm import compile_beside_batches, prewarm_kernels
from service.app.factory import App, open_app
from service.feature import known_features
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import load_missions
from service.missions.motion import LiveFilterSettings
from service.settings import Settings
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.sql.migrations import upgrade
from service.web.app import create_app
from service.web.openapi import EXAMPLE_REQUESTS, EXAMPLES
from service.web.server import Server, configuration

API = "/api/v1"
Json = dict[str, Any]


class Walk:
    """Requests to a service, with the answers that are examples by operation and status."""

    def __init__(self, client: httpx.Client, app: App, sky: SkyModel) -> None:
        self.client, self.app, self.sky = client, app, sky
        self.found: Json = {}

    def take(self, operation: str, answer: httpx.Response, name: str, asked: Any = None) -> Json:
        """Add an answer, with the body of its request, to the examples; its content."""
        entry = self.found.setdefault(operation, {})
        if asked is not None:
            entry.setdefault("request", {})[name] = asked
        content: Json = answer.json()
        entry.setdefault(str(answer.status_code), {})[name] = content
        return content

    def drawn(self, spacecraft: str, **wanted: Any) -> Json:
        """Batch of a spacecraft over the real catalog."""
        wanted_pass = Pass(batches=1, troubles=NO_TROUBLES, angles_share=0.0, **wanted)
        (drawn,) = draw_pass(load_missions()[spacecraft], self.sky, wanted_pass)
        return drawn.batch

    def ended(self, address: str) -> httpx.Response:
        """Answer about work in the background when it is over."""
        while (found := self.client.get(address)).json()["state"] in ("queued", "running"):
            time.sleep(0.05)
        return found

    def send_declared(self) -> None:
        """Send the requests that handlers declare by `Example`."""
        addresses = self.client.get(f"{API}/openapi.json").json()["paths"]
        for path, operations in addresses.items():
            for method, described in operations.items():
                for each in EXAMPLE_REQUESTS.get(described["operationId"], ()):
                    url = path.format_map(each.path) + (f"?{each.query}" if each.query else "")
                    answer = self.client.request(method, url, json=each.body)
                    asked = None if each.body is None else dict(each.body)
                    self.take(described["operationId"], answer, each.name, asked)


def walk(client: httpx.Client, app: App, sky: SkyModel) -> Json:
    """Requests and answers by operation and status, of a walk through every route."""
    walk = Walk(client, app, sky)
    xte = _batches(walk)
    app.projector.make_heads()
    walk.send_declared()
    _gyro(walk)
    _runs(walk, xte)
    _annotation(walk)
    _measured(walk)
    for feature in known_features().values():
        if find_spec(name := f"{feature.package}.examples"):
            import_module(name).send(walk)
    _sign_in(walk)
    return walk.found


def _batches(walk: Walk) -> Json:
    """Send batches; the first batch."""
    client, take = walk.client, walk.take

    def submit(name: str, body: Json, **headers: str) -> Json:
        answer = client.post(f"{API}/batches", json=body, headers=headers)
        return take("submit_batch", answer, name, body if answer.status_code == 201 else None)

    xte = walk.drawn("XTE", stars=3)
    first = submit("attitude", xte, **{"Idempotency-Key": "1999-060-0001"})
    lone = xte["observations"][0] | {"stars": xte["observations"][0]["stars"][:1]}
    submit("no_attitude", xte | {"batch": "1999-060-0002", "observations": [lone]})
    submit("direction_only", walk.drawn("SWAS", stars=3, prior="direction"))
    submit("sun_pointed", walk.drawn("SOHO", stars=3, prior="direction"))
    other = xte | {"aberration": "ignore"}
    submit("another_body", other)
    submit("key_of_another_body", other, **{"Idempotency-Key": "1999-060-0001"})
    submit("unknown_spacecraft", xte | {"spacecraft": "NOPE"})
    submit("faults", xte | {"time": "noon", "aberration": "maybe", "colour": "red"})
    headers = {"Content-Type": "application/json"}
    truncated = client.post(f"{API}/batches", content=b'{"spacecraft": "XTE"', headers=headers)
    take("submit_batch", truncated, "truncated")
    take("submit_batch", client.post(f"{API}/batches", content=b"{}"), "no_content_type")

    new = xte | {"batch": "1999-060-0003"}
    asked: Any = [new, xte, other, xte | {"spacecraft": "NOPE"}]
    sent = client.post(f"{API}/batches/many", json=asked)
    take("submit_batches", sent, "new_recorded_conflict_unknown", asked)
    take("submit_batches", client.post(f"{API}/batches/many", json=[]), "none")

    here = f"{API}/batches/{first['id']}"
    asked = {"options": {"identifier": "starid", "tolerances": {"separation_deg": 0.02}}}
    take("what_if", client.post(f"{here}/what-if", json=asked), "not_recorded", asked)
    asked = {"options": {"solver": "triad"}, "adopt": True}
    take("what_if", client.post(f"{here}/what-if", json=asked), "adopted", asked)
    take("get_batch", client.get(here), "superseded")
    return xte


def _runs(walk: Walk, xte: Json) -> None:
    """Send what concerns zones, runs and replays."""
    client, take = walk.client, walk.take
    asked = {"spacecraft": "XTE", "time": xte["time"], "a_priori": [xte["a_priori"]]}
    take("warm_zones", client.post(f"{API}/zones", json=asked), "one", asked)
    take("list_zones", client.get(f"{API}/zones"), "cache")
    take("drop_zones", client.delete(f"{API}/zones?spacecraft=SOHO"), "of_soho")

    content = json.dumps(xte) + '\n{"truncated\n'
    headers = {"Content-Type": "application/x-ndjson"}
    begun = client.post(f"{API}/replays?run=pass-7", content=content, headers=headers)
    take("start_replay", begun, "begun")
    take("get_replay", walk.ended(begun.headers["Location"]), "done_with_a_bad_line")
    take("list_runs", client.get(f"{API}/runs"), "two")
    take("list_replays", client.get(f"{API}/replays"), "one")
    asked = {"alarms": True}
    take("watch_run", client.put(f"{API}/runs/pass-7", json=asked), "watched", asked)

    take("list_audit", client.get(f"{API}/audit"), "changes")
    asked = {"batches": [xte["batch"]], "confirm": False}
    take("forget_run", client.post(f"{API}/runs/pass-7/forget", json=asked), "asked", asked)
    take("cancel_replay", client.delete(begun.headers["Location"]), "ended_already")
    # The same batch again and again: it is cancelled long before its end.
    compressed = gzip.compress(f"{json.dumps(xte)}\n".encode() * 100_000)
    packed = headers | {"Content-Encoding": "gzip"}
    begun = client.post(f"{API}/replays?run=pass-8", content=compressed, headers=packed)
    while not client.get(begun.headers["Location"]).json()["counts"]["repeated"]:
        time.sleep(0.05)
    take("cancel_replay", client.delete(begun.headers["Location"]), "cancelled")


def _annotation(walk: Walk) -> None:
    client, take = walk.client, walk.take
    here = f"{API}/annotations"
    asked = {
        "spacecraft": "XTE",
        "start": "1999-03-01T00:00:00.000Z",
        "end": "1999-03-01T00:20:00.000Z",
        "text": "Wheel 2 unloaded; the slew ends at 00:20.",
        "who": "J. Operator",
    }
    written = take("add_annotation", client.post(here, json=asked), "period", asked)
    backwards = asked | {"end": "1999-02-28T00:00:00.000Z"}
    take("add_annotation", client.post(here, json=backwards), "backwards")
    take("list_annotations", client.get(f"{here}?spacecraft=XTE"), "of_xte")
    note = f"{here}/{written['id']}?who=J.%20Operator"
    take("delete_annotation", client.delete(note), "deleted")
    take("delete_annotation", client.delete(note), "deleted_before")


def _gyro(walk: Walk) -> None:
    client, take = walk.client, walk.take
    here = f"{API}/spacecraft/XTE/gyro"
    rates = [[1.1e-3, -2e-5, 0.0], [1.1e-3, -3e-5, 1e-5], [1.2e-3, -2e-5, 0.0]]
    asked: Json = {"block": "1999-060-g1", "start": "1999-03-01T00:00:00.000Z", "step_s": 0.1}
    asked["rates_rad_per_s"] = rates
    first = take("submit_gyro", client.post(here, json=asked), "step", asked)
    take("submit_gyro", client.post(here, json=asked), "again")
    take("submit_gyro", client.post(here, json=asked | {"step_s": 0.2}), "another_body")
    late: Json = {"block": "1999-060-g2", "start": "1999-03-01T00:00:00.300Z"}
    late |= {"times_s": [0.0, 0.1, 0.25], "rates_rad_per_s": rates}
    take("submit_gyro", client.post(here, json=late), "times", late)
    overlapping = late | {"block": "1999-060-g3", "start": "1999-03-01T00:00:00.200Z"}
    take("submit_gyro", client.post(here, json=overlapping), "sample_of_another_block")
    degrees = late | {"block": "1999-060-g4", "rates_rad_per_s": [[0.0, 100.0, 0.0]] * 3}
    take("submit_gyro", client.post(here, json=degrees), "another_unit")
    take("list_gyro", client.get(here), "two_blocks")
    take("get_gyro", client.get(f"{here}/{first['id']}"), "three_samples")


def _measured(walk: Walk) -> None:
    client, take = walk.client, walk.take
    for number, second in enumerate(("10", "20", "30"), 1):
        body = {
            "spacecraft": "SWAS",
            "batch": f"ST1-000{number}",
            "time": f"1999-03-02T00:00:{second}.000Z",
            "a_priori": None,
            "measurement": {
                "quaternion": [0.1, 0.2, 0.3, 0.9273618495495703],
                "sigma_arcsec": [6.0, 6.0, 40.0],
            },
        }
        answer = client.post(f"{API}/batches", json=body)
        if number == 1:
            take("submit_batch", answer, "measured_attitude", body)


def _sign_in(walk: Walk) -> None:
    client, take = walk.client, walk.take
    operator = {"name": "J. Operator", "scopes": ["read", "operate"], "days": 90}
    made = take("add_token", client.post(f"{API}/tokens", json=operator), "operator", operator)
    secret = made["token"]
    shown = {"Authorization": f"Bearer {secret}"}
    pipeline = {"name": "pipeline", "scopes": ["submit"], "spacecraft": ["XTE"], "rate_per_s": 50}
    added = client.post(f"{API}/tokens", json=pipeline, headers=shown)
    take("add_token", added, "pipeline", pipeline)
    again = client.post(f"{API}/tokens", json=pipeline, headers=shown)
    take("add_token", again, "name_is_taken")
    take("list_tokens", client.get(f"{API}/tokens", headers=shown), "two")
    revoked = client.delete(f"{API}/tokens/pipeline", headers=shown)
    take("revoke_token", revoked, "revoked")
    take("revoke_token", client.delete(f"{API}/tokens/nobody", headers=shown), "unknown")
    asked = {"token": "acq_the-secret-that-was-printed-once"}
    take("list_runs", client.get(f"{API}/runs"), "no_token")
    take("sign_in", client.post(f"{API}/session", json=asked), "unknown", asked)
    take("sign_in", client.post(f"{API}/session", json={"token": secret}), "operator")
    same = {"Sec-Fetch-Site": "same-origin"}
    take("sign_out", client.delete(f"{API}/session", headers=same), "signed_out")


@contextmanager
def _served(app: App) -> Iterator[str]:
    """Address of a server of an app, in a thread of this process."""
    web_app = create_app(app)
    server = Server(configuration(Settings(port=0), web_app), web_app.state.live.stop)
    thread = Thread(target=server.run, name="server")
    thread.start()
    try:
        while thread.is_alive() and not server.started:
            time.sleep(0.05)
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


def fresh_walk() -> Json:
    """The walk through a service with an empty database, and a live filter for SWAS."""
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    # Where no kernel is compiled yet, that takes longer than a client waits.
    prewarm_kernels(sky, load_missions(), IDENTIFIERS, seldom=True)
    compile_beside_batches()
    swas = load_missions()["SWAS"].model_copy(update={"live_filter": LiveFilterSettings()})
    with tempfile.TemporaryDirectory() as folder:
        database = f"sqlite:///{Path(folder, 'acquire.db')}"
        upgrade(database)
        app = open_app(Settings(database=database, replay_processes=0), swas)
        with _served(app) as address, httpx.Client(base_url=address, timeout=300) as client:
            return walk(client, app, sky)


def packages() -> dict[str, str]:
    """The package that holds the examples of each operation of a feature."""
    features = [each for each in known_features().values() if "routes" in each.brings]
    return {
        route.name: feature.package
        for feature in features
        for router in import_module(f"{feature.package}.routes").ROUTERS
        for route in router.routes
    }


def keep_recorded(walked: Any, again: Any, recorded: Any) -> Any:
    """Return an answer with the recorded values where two walks differ, as in ids and times."""
    if isinstance(walked, dict) and isinstance(recorded, dict):
        # Two durations in microseconds may be equal by chance.
        others = again if isinstance(again, dict) else {}
        others = {name: value for name, value in others.items() if not name.endswith("_us")}
        return {
            name: keep_recorded(value, others.get(name), recorded[name])
            if name in recorded
            else value
            for name, value in walked.items()
        }
    lists = [each for each in (walked, again, recorded) if isinstance(each, list)]
    if len(lists) == 3 and len({len(each) for each in lists}) == 1:
        return [keep_recorded(*each) for each in zip(*lists, strict=True)]
    return recorded if walked != again and type(walked) is type(recorded) else walked


def write(walked: Json, again: Json) -> None:
    """Write the examples of operations to the folders of their routes.

    What two walks answer alike is written; elsewhere the files keep what they hold.
    """
    own = packages()
    parts: dict[str, Json] = defaultdict(dict)
    for operation, known in walked.items():
        parts[own.get(operation, "service.web")][operation] = known
    for package, part in parts.items():
        file = Path(str(files(package)), EXAMPLES)
        recorded = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        part = keep_recorded(part, {name: again[name] for name in part}, recorded)
        text = json.dumps(part, indent=1, ensure_ascii=False) + "\n"
        file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    # With `--help` the parser ends the program before it writes the file.
    argparse.ArgumentParser(prog="python -m service.web.examples", description=__doc__).parse_args()
    write(fresh_walk(), fresh_walk())
