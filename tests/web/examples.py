"""The examples of `openapi.yaml`, taken from a real run: `python -m tests.web.examples`.

They are written to `examples.json` of `service/web`, and of each feature for its own routes;
`make openapi` then puts them into `openapi.yaml`.
"""

import argparse
import gzip
import json
import tempfile
import time
from collections import defaultdict
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import httpx

from service.app.factory import App, open_app
from service.feature import known_features
from service.features.definitive.part import Definitive
from service.missions.mission import load_missions
from service.missions.motion import LiveFilterSettings
from service.simulate.frames import FrameSettings, draw_frames, frame_bytes
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.web.app import create_app
from service.web.openapi import EXAMPLES
from tests.fresh_databases import sqlite_at
from tests.web.serving import Server, compile_kernels, ended, in_process_settings

ROOT = Path(__file__).parents[2]
API = "/api/v1"
Json = dict[str, Any]


def walk(client: httpx.Client, app: App) -> Json:
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

    xte = _drawn("XTE", stars=3)
    first = submit("attitude", xte, **{"Idempotency-Key": "1999-060-0001"})
    lone = xte["observations"][0] | {"stars": xte["observations"][0]["stars"][:1]}
    submit("no_attitude", xte | {"batch": "1999-060-0002", "observations": [lone]})
    submit("direction_only", _drawn("SWAS", stars=3, prior="direction"))
    submit("sun_pointed", _drawn("SOHO", stars=3, prior="direction"))
    other = xte | {"aberration": "ignore"}
    submit("another_body", other)
    submit("key_of_another_body", other, **{"Idempotency-Key": "1999-060-0001"})
    submit("unknown_spacecraft", xte | {"spacecraft": "NOPE"})
    submit("faults", xte | {"time": "noon", "aberration": "maybe", "colour": "red"})
    headers = {"Content-Type": "application/json"}
    truncated = client.post(f"{API}/batches", content=b'{"spacecraft": "XTE"', headers=headers)
    take("submit_batch", truncated, "truncated")
    take("submit_batch", client.post(f"{API}/batches", content=b"{}"), "no_content_type")

    frame, file = _frame()
    new = xte | {"batch": "1999-060-0003"}
    asked = [new, xte, other, xte | {"spacecraft": "NOPE"}]
    sent = client.post(f"{API}/batches/many", json=asked)
    take("submit_batches", sent, "new_recorded_conflict_unknown", asked)
    take("submit_batches", client.post(f"{API}/batches/many", json=[]), "none")

    take("submit_frame", _send(client, "IMAGER", frame, file), "attitude")
    cut_off = frame | {"batch": "cut-off"}
    take("submit_frame", _send(client, "IMAGER", cut_off, file[:5760]), "cut_off")
    take("submit_frame", _send(client, "XTE", frame, file), "no_camera")

    octets = {"Content-Type": "application/octet-stream"}
    solve = f"{API}/pictures?spacecraft=IMAGER"
    solved = client.post(solve, content=file, headers=octets)
    del take("solve_picture", solved, "found")["stars"][2:]
    cut_off = client.post(solve, content=file[:5760], headers=octets)
    take("solve_picture", cut_off, "cut_off")

    here = f"{API}/batches/{first['id']}"
    asked = {"options": {"identifier": "starid", "tolerances": {"separation_deg": 0.02}}}
    take("what_if", client.post(f"{here}/what-if", json=asked), "not_recorded", asked)
    asked = {"options": {"solver": "triad"}, "adopt": True}
    take("what_if", client.post(f"{here}/what-if", json=asked), "adopted", asked)
    take("get_batch", client.get(here), "superseded")
    take("list_batches", client.get(f"{API}/batches?spacecraft=XTE&limit=1"), "first_page")
    mine = client.get(f"{API}/batches?spacecraft=XTE&batch=1999-060-0003")
    take("list_batches", mine, "by_batch_id")
    take("list_batches", client.get(f"{API}/batches?limit=ten"), "limit")
    take("get_latest", client.get(f"{API}/spacecraft/SOHO/latest"), "soho")
    take("get_latest", client.get(f"{API}/spacecraft/XTE/latest?run=none"), "empty_run")

    take("list_spacecraft", client.get(f"{API}/spacecraft"), "all")
    take("get_spacecraft", client.get(f"{API}/spacecraft/SOHO"), "soho")
    take("get_spacecraft", client.get(f"{API}/spacecraft/NOPE"), "unknown")
    take("get_overview", client.get(f"{API}/overview"), "live")
    take("get_about", client.get(f"{API}/about"), "here")
    app.projector.make_heads()
    take("get_record_head", client.get(f"{API}/record/head"), "first")
    asked = {
        "spacecraft": "XTE",
        "sample": 5,
        "b": {"identifier": "starid", "tolerances": {"separation_deg": 1e-5}},
    }
    take("compare", client.post(f"{API}/compare", json=asked), "tighter", asked)
    _alarm(client, take)
    take("list_attitudes", client.get(f"{API}/spacecraft/SWAS/attitudes"), "one")
    take("get_attitude", client.get(f"{API}/spacecraft/SWAS/attitude"), "one")
    moment = f"{API}/spacecraft/SWAS/attitude/at?status=all&method=nearest"
    take("get_attitude_at", client.get(f"{moment}&time=1999-060T00:00:05Z"), "nearest")
    take("get_attitude_at", client.get(f"{moment}&time=1999-061T00:00:00Z"), "none")
    take("get_live_attitude", client.get(f"{API}/spacecraft/XTE/attitude/latest"), "not_kept_up")
    take("list_rates", client.get(f"{API}/spacecraft/XTE/rates"), "one_hour")

    _gyro(client, take)
    _tracks(client, take)
    history = f"{API}/spacecraft/XTE/history"
    take("get_history", client.get(f"{history}?quantity=residual_ratio&size=10"), "one_bucket")
    latest = client.get(f"{history}?strategy=latest&quantity=ambiguous_share&size=1")
    take("get_history", latest, "latest_batch")
    take("list_worst", client.get(f"{API}/spacecraft/XTE/worst?limit=1"), "by_ambiguous_share")
    advice = f"{API}/spacecraft/XTE/advice"
    take("get_advice", client.get(f"{advice}?tolerance=separation_deg=0.01"), "of_two_batches")
    take("get_advice", client.get(f"{advice}?tolerance=septol=1"), "tolerance")

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
    take("list_replays", client.get(f"{API}/replays"), "one")
    asked = {"alarms": True}
    take("watch_run", client.put(f"{API}/runs/pass-7", json=asked), "watched", asked)

    take("list_audit", client.get(f"{API}/audit"), "two_changes")
    asked = {"batches": [xte["batch"]], "confirm": False}
    take("forget_run", client.post(f"{API}/runs/pass-7/forget", json=asked), "asked", asked)
    _annotation(client, take)
    _webhook(client, take)
    take("cancel_replay", client.delete(begun.headers["Location"]), "ended_already")
    # The same batch again and again: it is cancelled long before its end.
    content = gzip.compress(f"{json.dumps(xte)}\n".encode() * 100_000)
    packed = headers | {"Content-Encoding": "gzip"}
    begun = client.post(f"{API}/replays?run=pass-8", content=content, headers=packed)
    while not client.get(begun.headers["Location"]).json()["counts"]["repeated"]:
        time.sleep(0.05)
    take("cancel_replay", client.delete(begun.headers["Location"]), "cancelled")
    _calibration(client, take)
    _measured(client, app, take)
    take("session", client.get(f"{API}/session"), "open_access")
    _sign_in(client, take)
    return found


def _alarm(client: httpx.Client, take: Any) -> None:
    here = f"{API}/spacecraft/SWAS/limits"
    settings = {"warning": {"high": 0.5}, "minimum_count": 2, "duration_s": 0}
    asked = {"settings": settings, "who": "J. Operator", "comment": "for the next pass"}
    limit = f"{here}/no_attitude_share"
    tried = {"settings": settings}
    preview = client.post(f"{limit}/preview", json=tried)
    take("preview_limit", preview, "of_one_batch", tried)
    take("set_limit", client.put(limit, json=asked), "changed", asked)
    take("get_limit", client.get(limit), "with_history")
    take("list_limits", client.get(here), "of_swas")
    client.put(f"{API}/runs/pass-8", json={"alarms": True})
    lone = _drawn("SWAS", stars=1)
    for name in ("1999-060-0001", "1999-060-0002"):
        client.post(f"{API}/batches", json=lone | {"batch": name, "run": "pass-8"})
    found = take("list_alarms", client.get(f"{API}/alarms?run=pass-8"), "open")
    alarm = f"{API}/alarms/{found['items'][0]['id']}"
    said = {"who": "J. Operator", "comment": "one star in view"}
    shelved = {**said, "minutes": 60}
    take("shelve_alarm", client.post(f"{alarm}/shelve", json=shelved), "an_hour", shelved)
    take("unshelve_alarm", client.post(f"{alarm}/unshelve", json=said), "back", said)
    take("comment_alarm", client.post(f"{alarm}/comment", json=said), "said", said)
    acknowledge = f"{alarm}/acknowledge"
    take("acknowledge_alarm", client.post(acknowledge, json=said), "seen", said)
    take("acknowledge_alarm", client.post(acknowledge, json=said), "seen_before")
    take("get_alarm", client.get(alarm), "with_what_was_done")
    take("reset_limit", client.delete(f"{limit}?who=J.%20Operator"), "shipped_again")


def _calibration(client: httpx.Client, take: Any) -> None:
    """The scale of one tracker, from a run of its own."""
    mission = load_missions()["XTE"]
    wanted = Pass(batches=20, troubles=NO_TROUBLES, angles_share=1.0)
    for drawn in draw_pass(mission, _sky(), wanted):
        client.post(f"{API}/batches", json=drawn.batch | {"run": "commissioning"})
    here, signed = f"{API}/calibrations", {"who": "J. Operator"}
    asked: Json = {"spacecraft": "XTE", "run": "commissioning", "degree": 0, **signed}
    begun = client.post(here, json=asked)
    take("start_calibration", begun, "scale", asked)
    other = client.post(here, json=asked | {"trackers": ["STARTRACKER_2"]})
    take("start_calibration", other, "no_such_tracker")
    one = begun.headers["Location"]
    while (found := client.get(one)).json()["state"] in ("queued", "running"):
        time.sleep(0.05)
    # A map has a hundred cells.
    shown: Json = found.json()
    shown["result"]["maps"][0]["cells"] = shown["result"]["maps"][0]["cells"][:2]
    take("get_calibration", httpx.Response(200, json=shown), "scale")
    take("list_calibrations", client.get(here), "one")
    tried: Json = {"sample": 5}
    take("try_calibration", client.post(f"{one}/trial", json=tried), "five_batches", tried)
    reason = {**signed, "note": "scale after the first pass"}
    take("adopt_calibration", client.post(f"{one}/adopt", json=reason), "first", reason)
    take("adopt_calibration", client.post(f"{one}/adopt", json=reason), "in_force_already")
    mission_file: Json = {**signed, "to": None}
    held = f"{API}/spacecraft/XTE/calibration"
    back = client.post(f"{held}/revert", json=mission_file)
    take("revert_calibration", back, "to_the_mission_file", mission_file)
    take("get_calibration_in_force", client.get(held), "the_mission_file")


def _annotation(client: httpx.Client, take: Any) -> None:
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


def _gyro(client: httpx.Client, take: Any) -> None:
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
    take("list_innovations", client.get(f"{API}/spacecraft/XTE/innovations"), "none_smoothed")
    _definitive(client, take)
    take("get_gyro", client.get(f"{here}/{first['id']}"), "three_samples")


def _definitive(client: httpx.Client, take: Any) -> None:
    here = f"{API}/spacecraft/XTE/definitive-attitude"
    asked: Json = {"run": "none", "start": "1999-03-01T00:00:00Z", "who": "J. Operator"}
    begun = take("make_definitive_attitude", client.post(here, json=asked), "a_day", asked)
    ended(client, f"{here}/{begun['id']}")
    take("get_definitive_attitude", client.get(f"{here}/{begun['id']}"), "without_batches")
    take("list_definitive_attitudes", client.get(here), "one")


def _measured(client: httpx.Client, app: App, take: Any) -> None:
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
    app.part(Definitive).live_filter.refresh("SWAS")
    take("get_live_attitude", client.get(f"{API}/spacecraft/SWAS/attitude/latest"), "swas")


def _tracks(client: httpx.Client, take: Any) -> None:
    """Four batches a second apart, in which one point moves among three stars."""
    batch = _drawn("XTE", stars=3) | {"run": "pass-9"}
    (seen,) = batch["observations"]
    for k in range(4):
        point = {"vector": [0.01 + 1e-4 * k, 0.02, 0.99975], "magnitude": 5.0}
        own = {"batch": f"1999-060-t{k}", "time": f"1999-03-01T00:00:{10 + k}.000Z"}
        own["observations"] = [seen | {"stars": [*seen["stars"], point]}]
        client.post(f"{API}/batches", json=batch | own).raise_for_status()
    here = f"{API}/spacecraft/XTE/tracks"
    take("list_tracks", client.get(f"{here}?run=pass-9"), "one_moves")
    take("list_tracks", client.get(f"{here}?run=none&format=aem"), "format")


def _webhook(client: httpx.Client, take: Any) -> None:
    """A receiver whose name is unknown (RFC 2606), so that a walk sends nothing anywhere."""
    here = f"{API}/webhooks"
    asked = {
        "name": "pager",
        "url": "https://receiver.invalid/acquire",
        "kinds": ["alarm"],
        "severity": "warning",
    }
    added = take("add_webhook", client.post(here, json=asked), "alarms", asked)
    inside = asked | {"url": "https://169.254.169.254/latest/meta-data"}
    take("add_webhook", client.post(here, json=inside), "not_a_public_address")
    take("list_webhooks", client.get(here), "one")
    webhook = f"{here}/{added['id']}"
    take("test_webhook", client.post(f"{webhook}/test"), "unknown_name")
    hours = {"previous_hours": 24}
    rotated = client.post(f"{webhook}/secret", json=hours)
    take("rotate_webhook_secret", rotated, "new_secret", hours)
    every = asked | {"kinds": None, "spacecraft": ["XTE"], "run": "*", "enabled": False}
    take("change_webhook", client.put(webhook, json=every), "paused", every)
    take("test_webhook", client.post(f"{webhook}/test"), "paused")
    period = {"since": "1999-03-01T00:00:00.000Z", "until": "1999-03-02T00:00:00.000Z"}
    replayed = client.post(f"{webhook}/replay", json=period)
    take("replay_events", replayed, "none_in_the_period", period)
    every_letter: Json = {"events": None}
    retried = client.post(f"{webhook}/retry", json=every_letter)
    take("retry_dead_letters", retried, "none_is_dead", every_letter)
    take("list_webhook_deliveries", client.get(f"{webhook}/deliveries"), "none_waits")
    take("get_webhook", client.get(webhook), "paused")
    take("delete_webhook", client.delete(webhook), "deleted")
    take("get_webhook", client.get(webhook), "unknown")


def _sign_in(client: httpx.Client, take: Any) -> None:
    operator = {"name": "J. Operator", "scopes": ["read", "operate"], "days": 90}
    made = take("add_token", client.post(f"{API}/tokens", json=operator), "operator", operator)
    secret = made["token"]
    shown = {"Authorization": f"Bearer {secret}"}
    pipeline = {"name": "pipeline", "scopes": ["submit"], "spacecraft": ["XTE"], "rate_per_s": 50}
    asked = client.post(f"{API}/tokens", json=pipeline, headers=shown)
    take("add_token", asked, "pipeline", pipeline)
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


@cache
def _sky() -> SkyModel:
    return SkyModel(load_embedded(), LruCache(64 << 20))


def _frame() -> tuple[Json, bytes]:
    """What is told of a frame, as a query, and its file."""
    (drawn,) = draw_frames(load_missions()["IMAGER"], _sky(), FrameSettings(frames=1))
    query = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in drawn.known.items()
    }
    return query, frame_bytes(drawn)


def _send(client: httpx.Client, spacecraft: str, query: Json, file: bytes) -> httpx.Response:
    headers = {"Content-Type": "application/fits"}
    url = f"{API}/spacecraft/{spacecraft}/frames"
    return client.post(url, params=query, content=file, headers=headers)


def _drawn(spacecraft: str, **wanted: Any) -> Json:
    wanted_pass = Pass(batches=1, troubles=NO_TROUBLES, angles_share=0.0, **wanted)
    (drawn,) = draw_pass(load_missions()[spacecraft], _sky(), wanted_pass)
    return drawn.batch


def fresh_walk() -> Json:
    """The walk through a server of its own with an empty database."""
    with tempfile.TemporaryDirectory() as folder:
        # Where nothing is compiled yet, that takes longer than a client waits.
        compile_kernels()
        kept_up = {"live_filter": LiveFilterSettings()}
        app = open_app(
            in_process_settings(sqlite_at(Path(folder) / "acquire.db")),
            load_missions()["SWAS"].model_copy(update=kept_up),
        )
        with (
            Server(create_app(app)) as address,
            httpx.Client(base_url=address, timeout=300) as client,
        ):
            return walk(client, app)


def packages() -> dict[str, str]:
    """The package that holds the examples of each operation of a feature."""
    features = [each for each in known_features().values() if "routes" in each.brings]
    return {
        route.name: feature.package
        for feature in features
        for router in import_module(f"{feature.package}.routes").ROUTERS
        for route in router.routes
    }


def write(found: Json) -> None:
    """Write the examples of operations to the folders of their routes."""
    own, parts = packages(), defaultdict(dict)
    for operation, known in found.items():
        parts[own.get(operation, "service.web")][operation] = known
    for package, part in parts.items():
        file = ROOT.joinpath(*package.split("."), EXAMPLES)
        text = json.dumps(part, indent=1, ensure_ascii=False) + "\n"
        file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    # With `--help` the parser ends the program before it writes the file.
    argparse.ArgumentParser(prog="python -m tests.web.examples", description=__doc__).parse_args()
    write(fresh_walk())
