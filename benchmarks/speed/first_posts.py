"""First posts to a fresh server: durations of the slowest ones, and their searches.

    python -m benchmarks first_posts

Simulated telemetry of XTE, SWAS and SOHO with its usual errors, mixed, sent one post after
another to a server that has just started, on a machine that has served them once: the kernels
are compiled and the files of the sky are built, but no zone is in the new server's cache.  Some
batches have a wrong a priori attitude: for those the service searches the whole sky.

Then first starts that are cut short: `acquire demo` with nothing compiled is interrupted at a
random moment, and the posts go to a server that starts after it, while that one compiles the
rest.  A post that is answered 503 is sent again after the time that its answer names; the wait
that counts is the last one.  When all is compiled some posts are sent again: nothing may be
compiled for them.
"""

import http.client
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import at_least, at_most, equal
from benchmarks.report import Report
from benchmarks.speed.compiling import empty_loop_s
from benchmarks.speed.posts import API
from benchmarks.speed.serving import Served, free_port, service
from service.missions.mission import load_missions
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

MISSIONS = ("XTE", "SWAS", "SOHO")
POSTS, QUICK_POSTS = 3_000, 300
MOST_MS = 150.0
CUT_STARTS, QUICK_CUT_STARTS = 10, 1
LATEST_CUT_S = 60.0
"""Greatest delay in seconds before a first start is interrupted, about the compile time."""
COMPILING_S = 1800.0
LEAST_WHOLE_SKY = 0.01
"""Least share of posts that need a search of the whole sky."""


class Post(NamedTuple):
    """Duration of a post, processor time of the server's threads, and the kind of search."""

    wait_ms: float
    processor_ms: float
    status: int
    spacecraft: str
    batch: str
    path: str
    refused: int
    """Number of earlier answers with status 503."""


class CutStart(NamedTuple):
    """Posts after an interrupted first start, and number of kernels compiled after the build."""

    after_s: float
    posts: list[Post]
    compiled_late: int


def run(quick: bool, seed: int) -> Report:
    """Benchmark of first posts."""
    bodies = _bodies(QUICK_POSTS if quick else POSTS, seed)
    with tempfile.TemporaryDirectory() as folder:
        with service(Path(folder) / "once.db") as served:
            once = _posted(served, bodies)
        with service(Path(folder) / "fresh.db") as served:
            posts = _posted(served, bodies)
    moments_s = np.random.default_rng(seed).uniform(
        0.0, LATEST_CUT_S, QUICK_CUT_STARTS if quick else CUT_STARTS
    )
    cut = [
        _cut_start(float(each), bodies)
        for each in tqdm(moments_s, unit=" cut starts", file=sys.stderr)
    ]
    waits = np.array([post.wait_ms for post in posts])
    whole_sky = [post for post in posts if "lost_in_space" in post.path]
    figures: dict[str, Any] = {
        "posts": len(posts),
        "posts that searched the whole sky": len(whole_sky),
        "median, ms": float(np.median(waits)),
        "99.9th percentile, ms": float(np.percentile(waits, 99.9)),
        "slowest that searched the whole sky, ms": max(
            (post.wait_ms for post in whole_sky), default=0.0
        ),
        "most processor time, ms": max(post.processor_ms for post in posts),
        "slowest to the server before it, ms": max(post.wait_ms for post in once),
    }
    for place, post in enumerate(sorted(posts, reverse=True)[:5], 1):
        what = f"{post.processor_ms:.1f} ms of processor time, {post.spacecraft} {post.batch}"
        figures[f"slowest {place}"] = f"{post.wait_ms:.1f} ms: {what}, {post.path}"
    for start in cut:
        slowest = max(start.posts)
        figures[f"cut after {start.after_s:.1f} s: slowest"] = (
            f"{slowest.wait_ms:.1f} ms, {slowest.processor_ms:.1f} ms of processor time, "
            f"{slowest.path}; 503 answered {sum(post.refused for post in start.posts)} times"
        )
    figures["empty loop of ten million rounds, s"] = empty_loop_s()
    after_cut = [post for start in cut for post in start.posts]
    bounds = [
        at_most("slowest post", float(waits.max()), MOST_MS, "ms"),
        at_most("slowest post after a cut start", max(after_cut).wait_ms, MOST_MS, "ms"),
        equal("kernels compiled late", sum(start.compiled_late for start in cut), 0),
        equal(
            "posts after a cut start answered with 201",
            *(sum(post.status == 201 for post in after_cut), len(cut) * len(bodies)),
        ),
        equal("posts answered with 201", sum(post.status == 201 for post in posts), len(bodies)),
        at_least("share of the whole sky", len(whole_sky) / len(posts), LEAST_WHOLE_SKY),
    ]
    return Report("first_posts", figures, bounds)


def _cut_start(after_s: float, bodies: Sequence[dict[str, Any]]) -> CutStart:
    """Interrupt a first start after a delay, and post to the next server."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = {"NUMBA_CACHE_DIR": str(folder / "kernels")}
        command = [sys.executable, "-m", "service.cli", "demo", "--port", str(free_port())]
        demo = subprocess.Popen(
            [*command, "--folder", str(folder / "demo")],
            env=os.environ | environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(after_s)
        # As Ctrl-C does, and also where this runs behind a shell, which has that ignored.
        demo.terminate()
        demo.wait(60)
        with service(folder / "next.db", environment=environment) as served:
            posts = _posted(served, bodies)
            built_at = _built_at(folder / "kernels")
            _posted(served, bodies[:QUICK_POSTS])
        kernels = (folder / "kernels").glob("*/*.nbc")
        late = sum(path.stat().st_mtime > built_at for path in kernels)
    return CutStart(after_s, posts, late)


def _built_at(kernels: Path) -> float:
    """Wait for the mark of a complete build; returns its time."""
    last = time.monotonic() + COMPILING_S
    while not (marks := list(kernels.glob("complete-*"))):
        if time.monotonic() > last:
            raise RuntimeError(f"the kernels are not compiled after {COMPILING_S:.0f} s")
        time.sleep(0.1)
    return marks[0].stat().st_mtime


def _bodies(count: int, seed: int) -> list[dict[str, Any]]:
    """Batches of the missions in rotation."""
    sky, missions = SkyModel(load_embedded(), LruCache(64 << 20)), load_missions()
    wanted = Pass(batches=count // len(MISSIONS), seed=seed)
    passes = [draw_pass(missions[name], sky, wanted) for name in MISSIONS]
    return [drawn.batch for together in zip(*passes, strict=True) for drawn in together]


def _posted(served: Served, bodies: Sequence[dict[str, Any]]) -> list[Post]:
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=120)
    posts = []
    for body in bodies:
        content = json.dumps(body).encode()
        refused = 0
        while True:
            before_ms = _processor_ms(served)
            started = time.perf_counter()
            connection.request(
                "POST", f"{API}/batches", content, {"Content-Type": "application/json"}
            )
            answer = connection.getresponse()
            received = answer.read()
            wait_ms = 1e3 * (time.perf_counter() - started)
            if answer.status != http.client.SERVICE_UNAVAILABLE:
                break
            refused += 1
            time.sleep(float(answer.headers["Retry-After"]))
        path = json.loads(received)["path"]
        spent_ms = _processor_ms(served) - before_ms
        posts.append(
            Post(
                *(wait_ms, spent_ms, answer.status, body["spacecraft"], body["batch"], path),
                refused=refused,
            )
        )
    connection.close()
    return posts


def _processor_ms(served: Served) -> float:
    spent_ns = 0
    for task in Path(f"/proc/{served.pid}/task").iterdir():
        # A thread may end after it was listed.
        with suppress(FileNotFoundError, ProcessLookupError):
            spent_ns += int((task / "schedstat").read_text().split()[0])
    return spent_ns / 1e6
