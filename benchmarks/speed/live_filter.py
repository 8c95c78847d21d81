"""Posts of batches and gyro blocks with the live filter, against the same batches without.

    python -m benchmarks live_filter

Two services run as they are served, each over a SQLite file of its own: one whose XTE has a live
filter that looks as often as a mission may ask for, one whose XTE has none.  Each turn posts the
same batches to both, to the first with the gyro blocks of that time.  Beside the times, the
answers must be the same, and the filtered attitude that of the pass.
"""

import json
import tempfile
import time
import urllib.error
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.report import Report
from benchmarks.speed.load import Driven, drive, request
from benchmarks.speed.posts import API, CONNECTIONS, read_json
from benchmarks.speed.serving import Served, service
from service.missions.mission import SHIPPED_FOLDER, Mission, read_mission
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import DrawnBatch, GyroWanted, draw_pass, with_gyro
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.vectors import attitude_error_arcsec, matrix_from_quaternion

TABLE = """
[live_filter]
every_s = 0.1
"""
POSTS, QUICK_POSTS = 1_000, 400
"""Posts of one turn over 16 connections: few, so that both services meet an equal load."""
ONE_BY_ONE = 100
"""Posts of one turn over one connection."""
ROUNDS, QUICK_ROUNDS = 16, 2
WARM = 400
COMPARED = 100
MOST_COST = 1.10
MOST_SIGMAS = 5.0
UP_TO_DATE_S = 60.0
"""Seconds to wait until the live filter has processed the last gyro sample."""
VARYING = ("id", "timings_us")
"""Parts of an answer that differ between any two posts."""


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the live filter."""
    count, rounds = (QUICK_POSTS, QUICK_ROUNDS) if quick else (POSTS, ROUNDS)
    with tempfile.TemporaryDirectory() as folder:
        missions = Path(folder) / "missions"
        missions.mkdir()
        mission = mission_in(missions)
        drawn = _drawn(mission, WARM + rounds * (count + ONE_BY_ONE), seed)
        with (
            service(Path(folder) / "with.db", missions) as filtering,
            service(Path(folder) / "without.db") as plain,
        ):
            return _measured(filtering, plain, drawn, count)


def mission_in(folder: Path) -> Mission:
    """Shipped XTE mission with a live filter, written to a folder of missions."""
    file = folder / "xte.toml"
    file.write_text((SHIPPED_FOLDER / "xte.toml").read_text("utf-8") + TABLE, "utf-8")
    return read_mission(file)


def _drawn(mission: Mission, count: int, seed: int) -> list[DrawnBatch]:
    """Nominal pass with a batch and a gyro sample per second."""
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    wanted = Pass(count, seed, cadence_s=1.0, troubles=NO_TROUBLES, angles_share=0.0)
    drawn = draw_pass(mission, sky, wanted)
    return list(with_gyro(drawn, mission, GyroWanted(), float(count), seed))


def _measured(filtering: Served, plain: Served, drawn: Sequence[DrawnBatch], count: int) -> Report:
    spent_s: dict[str, list[float]] = {"with": [], "without": []}
    p50_ms: dict[str, list[float]] = {"with": [], "without": []}
    servers = {"with": filtering, "without": plain}
    for name, server in servers.items():
        _post(server, drawn[:WARM], name, CONNECTIONS)
    cpu_s = {name: -server.cpu_s() for name, server in servers.items()}
    length = count + ONE_BY_ONE
    for number, first in enumerate(range(WARM, len(drawn), length)):
        part = drawn[first : first + length]
        # Alternate the order, since load may differ between first and second.
        for name in sorted(servers, reverse=number % 2 == 1):
            many = _post(servers[name], part[:count], name, CONNECTIONS)
            spent_s[name].append(many.seconds)
            one = _post(servers[name], part[count:], name, 1)
            p50_ms[name].append(one.percentile_ms(50))
    for name, server in servers.items():
        cpu_s[name] += server.cpu_s()
    posts = len(drawn) - WARM
    behind_s, latest = _up_to_date(filtering, drawn[-1])
    errors = attitude_error_arcsec(
        matrix_from_quaternion(latest["quaternion"]),
        matrix_from_quaternion(drawn[-1].truth["quaternion"]),
    )
    sigmas = np.sqrt(np.diag(latest["covariance_arcsec2"]))
    worst = float(np.abs(errors / sigmas).max())
    turns = [a / b for a, b in zip(spent_s["with"], spent_s["without"], strict=True)]
    # Over all turns together, since the filter runs in some of them only.
    ratio = sum(spent_s["with"]) / sum(spent_s["without"])
    cpu_ratio = cpu_s["with"] / cpu_s["without"]
    waits = [a / b for a, b in zip(p50_ms["with"], p50_ms["without"], strict=True)]
    compared, differing = _differing(filtering, plain)
    figures: dict[str, Any] = {
        "posts a second with gyro and filter": count * len(turns) / sum(spent_s["with"]),
        "posts a second without": count * len(turns) / sum(spent_s["without"]),
        "time of a post, with over without": ratio,
        "the same, lowest turn": min(turns),
        "the same, median turn": median(turns),
        "the same, highest turn": max(turns),
        "p50 over one connection with, ms": median(p50_ms["with"]),
        "p50 over one connection without, ms": median(p50_ms["without"]),
        "p50 with over without": median(waits),
        "cpu with, us a post": cpu_s["with"] / posts * 1e6,
        "cpu without, us a post": cpu_s["without"] / posts * 1e6,
        "cpu with over without": cpu_ratio,
        "batches of the filter's window": len(drawn),
        "seconds after the last post until the filter had the last sample": behind_s,
        "filtered attitude: one sigma, X / Y / Z, arcsec": " / ".join(f"{s:.2f}" for s in sigmas),
        "filtered attitude: largest error, sigmas": worst,
        "answers compared": compared,
    }
    bounds: list[Bound] = [
        at_most("time of a post, with over without", ratio, MOST_COST),
        at_most("p50 with over without", median(waits), MOST_COST),
        at_most("cpu with over without", cpu_ratio, MOST_COST),
        at_least("answers compared", compared, COMPARED),
        equal("answers that differ", differing, 0),
        at_most("error of the filtered attitude", worst, MOST_SIGMAS, "sigmas"),
    ]
    return Report("live_filter", figures, bounds)


def _post(server: Served, part: Sequence[DrawnBatch], name: str, connections: int) -> Driven:
    """Post batches, with their gyro blocks to the service with a filter."""
    driven = drive(server.port, list(_requests(part, name == "with")), connections)
    if set(driven.statuses) != {201}:
        raise RuntimeError(f"{name}: {driven.statuses}")
    return driven


def _requests(part: Sequence[DrawnBatch], has_gyro: bool) -> Iterator[bytes]:
    for each in part:
        body = each.batch | {"options": {"identifier": "starid"}}
        yield request(f"{API}/batches", json.dumps(body).encode())
        for block in each.gyro if has_gyro else ():
            own = {key: value for key, value in block.items() if key != "spacecraft"}
            path = f"{API}/spacecraft/{block['spacecraft']}/gyro"
            yield request(path, json.dumps(own).encode())


def _up_to_date(server: Served, last: DrawnBatch) -> tuple[float, dict[str, Any]]:
    """Seconds until the filter reaches the last gyro sample, and its attitude at that time."""
    begun = time.perf_counter()
    while (passed_s := time.perf_counter() - begun) < UP_TO_DATE_S:
        try:
            latest = read_json(server, f"{API}/spacecraft/XTE/attitude/latest")
        except urllib.error.HTTPError:
            latest = {"time": None}
        if latest["time"] == last.batch["time"]:
            return passed_s, dict(latest)
        time.sleep(0.05)
    raise RuntimeError(f"the filter is at {latest['time']}, not at {last.batch['time']}")


def _differing(filtering: Served, plain: Served) -> tuple[int, int]:
    """Number of newest batches compared between both services, and number of differing ones."""
    found = []
    for server in (filtering, plain):
        items = read_json(server, f"{API}/batches?limit={5 * COMPARED}")["items"]
        found.append({each["batch"]: each["id"] for each in items[::5]})
    common = sorted(found[0].keys() & found[1].keys())
    differing = 0
    for name in common:
        one, other = (
            _lasting(read_json(server, f"{API}/batches/{ids[name]}")["answer"])
            for server, ids in zip((filtering, plain), found, strict=True)
        )
        differing += one != other
    return len(common), differing


def _lasting(answer: dict[str, Any]) -> dict[str, Any]:
    """Answer without id, times, mission file and cache state."""
    kept = {key: value for key, value in answer.items() if key not in VARYING}
    kept["provenance"] = {k: v for k, v in answer["provenance"].items() if k != "mission"}
    for each in kept["observations"]:
        each["zone"].pop("cached")
    return kept
