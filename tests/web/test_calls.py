"""Posts, followed through their threads: calls go from higher floors to lower ones alone."""

import json
import os
import threading
import tomllib
from pathlib import Path

import httpx

import service
from service.app.factory import open_app
from service.feature import KINDS
from service.web.app import create_app
from tests.storage.samples import submission
from tests.waiting import wait_until
from tests.web.serving import Server, in_process_settings

SERVICE = Path(service.__file__).parent
CONTRACTS = tomllib.loads((SERVICE.parent / "pyproject.toml").read_text())["tool"]["importlinter"]


def floors():
    """The floors of the packages and modules that the import contracts name, lowest first."""
    found = {}
    for contract in CONTRACTS["contracts"]:
        if contract["type"] != "layers":
            continue
        (container,) = contract["containers"]
        folder = container.replace(".", "/").removeprefix("service").lstrip("/")
        for floor, names in enumerate(reversed(contract["layers"])):
            for name in names.split("|"):
                found[os.path.join(folder, name.strip())] = floor
    return found


class Calls:
    """The pairs of modules of the service of which one calls the other, in threads begun now on."""

    def __init__(self):
        self.pairs = set()
        self.is_on = False

    def record(self, frame, event, _argument):
        if not self.is_on or event != "call":
            return
        called = self._module(frame)
        if called is None:
            return
        caller = frame.f_back
        while caller is not None and (calling := self._module(caller)) is None:
            caller = caller.f_back
        if caller is not None:
            self.pairs.add((calling, called))

    @staticmethod
    def _module(frame):
        name = frame.f_code.co_filename
        if not name.startswith(f"{SERVICE}/"):
            return None
        return name.removeprefix(f"{SERVICE}/").removesuffix(".py")


def upward(pairs, floor_of):
    """The calls from a lower floor to a higher one, in `service` or within one of its packages.

    What a feature declares, such as its projection, is called by those that ask for it.
    """
    found = []
    for pair in pairs:
        calling, called = (each.split("/") for each in pair)
        depth = 1 if calling[0] != called[0] else 2
        names = "/".join(calling[:depth]), "/".join(called[:depth])
        if called[0] == "features" and called[-1] in KINDS:
            continue
        if all(name in floor_of for name in names) and floor_of[names[0]] < floor_of[names[1]]:
            found.append(pair)
    return sorted(found)


def test_a_post_and_its_repeat_pass_from_top_to_bottom(database, sky, missions):
    calls = Calls()
    threading.setprofile(calls.record)
    try:
        app = open_app(in_process_settings(database), serving=True)
        with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:

            def post(name, status=201, text=None, **headers):
                headers["Content-Type"] = "application/json"
                text = text or submission(sky, missions, name).text
                sent = client.post("/api/v1/batches", content=text, headers=headers)
                assert sent.status_code == status, sent.text

            wait_until(lambda: client.get("/readyz").status_code == 200)
            post("opens what it needs")
            app.store.progress.catch_up()
            calls.is_on = True
            post("followed")
            post("followed", 200, **{"Idempotency-Key": "given later"})
            asks_for_last = json.loads(submission(sky, missions, "predicted").text)
            asks_for_last["a_priori"] = {"from": "last"}
            post("predicted", text=json.dumps(asks_for_last))
            wait_until(lambda: app.store.progress.lag().results == 0)
            calls.is_on = False
    finally:
        threading.setprofile(None)
    called = {module for pair in calls.pairs for module in pair}
    passed = {
        "web/middleware",
        "web/api/batches",
        "ingest/submit",
        "ingest/queue",
        "acquire/pipeline",
        "storage/recording/writer",
        "storage/recording/results",
        "storage/projections/projector",
    }
    assert passed <= called
    assert upward(calls.pairs, floors()) == []


def test_a_call_upward_is_found():
    floor_of = floors()
    down = ("ingest/queue", "storage/recording/writer")
    assert upward({down}, floor_of) == []
    assert upward({down[::-1]}, floor_of) == [down[::-1]]
    within = ("storage/recording/writer", "storage/projections/projector")
    assert upward({within, within[::-1]}, floor_of) == [within]
