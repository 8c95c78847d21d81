"""Cost of a batch: cold and cached zones, identification and solution, with checked answers.

Times move with the machine, so each is shown as a ratio within this run as
well: to the call of a compiled function that does nothing with the same
arrays, and to the plain implementation of the tests, whose answers the
service's must equal star by star.
"""

import json
import statistics
import time
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.report import Report
from service.acquire import acquire
from service.acquire.prewarm import prewarm_kernels
from service.compiled.jit import njit
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import load_missions
from service.observations.batch import ObservationBatch
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from tests.missions.stated_files import STATED_FOLDER
from tests.reference import batches
from tests.reference.compare import Judge, zone_searched

BATCHES, QUICK_BATCHES = 300, 30
DEADLINE_S = {"cap": 4.0, "band": 600.0}
"""Deadline in seconds by kind of zone, required in 1994 of XTE and SWAS, and of SOHO."""
DEADLINE_FACTOR = 100.0
BOUND_US = {"cap": 100.0, "band": 400.0}
"""Limit in microseconds of the median identification and solution in a cached zone."""
WHOLE_US = {"cap": 200.0, "band": 700.0}
EMPTY_CALLS = {"cap": 60.0, "band": 400.0}
LEAST_OVER_PLAIN = 2.0
PLAIN = "plain implementation over the service"
HELD = "stars held against the plain implementation"
CONCURRENT = 50
MEGABYTES_256 = 256 << 20

PLACES = {
    "random cap": ("XTE", None),
    "cap forest": ("XTE", "forest"),
    "random band": ("SOHO", None),
    "band forest": ("SOHO", "forest"),
}


@njit(nogil=True)
def nothing(direction, magnitude, separation, brighter, dimmer, votes):  # type: ignore[no-untyped-def]
    """Compiled function without work: a lower limit of the cost of an identification."""
    return len(votes)


@dataclass(frozen=True)
class Place:
    """Figures of one kind of zone."""

    figures: dict[str, Any]
    bounds: list[Bound]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the pipeline in every place, with one sky."""
    sky = SkyModel(load_embedded(), LruCache(MEGABYTES_256))
    prewarm_kernels(sky, load_missions(), IDENTIFIERS)
    figures: dict[str, Any] = {}
    bounds: list[Bound] = []
    count = QUICK_BATCHES if quick else BATCHES
    with tqdm(total=len(PLACES) * count, desc="pipeline", unit="batch") as bar:
        for name in PLACES:
            place = measured(name, count, np.random.default_rng(seed), sky, bar.update)
            figures |= {f"{name}: {key}": value for key, value in place.figures.items()}
            bounds += [replace(each, figure=f"{name}: {each.figure}") for each in place.bounds]
    return Report("pipeline", figures, bounds)


def measured(
    name: str, count: int, rng: np.random.Generator, sky: SkyModel, step: Callable[[int], object]
) -> Place:
    """Figures of one place: nominal batches of five stars about one a priori attitude."""
    mission_name, place = PLACES[name]
    toml = tomllib.loads((STATED_FOLDER / f"{mission_name.lower()}.toml").read_text("utf-8"))
    judge = Judge(toml, sky)
    kind = toml["zone"]["kind"]
    attitudes = batches.prior_attitudes(rng, toml, 3)
    attitude = attitudes[2] if place is None else attitudes[1]
    moment = batches.TIMES[1]
    drawn = [
        batches.draw_batch(
            rng,
            toml,
            judge.catalog(moment),
            attitude,
            number,
            prior="quaternion",
            error_deg=3.0 if kind == "cap" else 0.1,
            stars=5,
            spurious=0,
            missing=0.0,
            noise_arcsec=2.1,
            magnitude_noise=0.1,
            options={},
            time=moment,
        )
        for number in range(count)
    ]
    read = [submission_from_json(json.dumps(batch)).batch for batch in drawn]
    cold_ms, built = _cold(read[0], judge, sky)
    step(0)
    identify: list[int] = []
    solve: list[int] = []
    whole: list[float] = []
    for batch in read:
        acquire(batch, judge.mission, sky)
    for batch in read:
        started = time.perf_counter_ns()
        found = acquire(batch, judge.mission, sky)
        whole.append((time.perf_counter_ns() - started) / 1000)
        identify.append(found.timings_us["identify"])
        solve.append(found.timings_us["solve"])
    zone = zone_searched(found, sky)
    empty_us = _empty_call_us(zone)
    begun = time.perf_counter()
    for body in drawn:
        judge.hold(body)
        step(1)
    plain_us = (time.perf_counter() - begun) / count * 1e6 - statistics.mean(whole)
    both = statistics.median(a + b for a, b in zip(identify, solve, strict=True))
    factor = DEADLINE_S[kind] / (cold_ms / 1000)
    figures: dict[str, Any] = {
        "stars and pairs of the zone": f"{len(zone.star):,} and {zone.pairs.count:,}",
        "cold zone, ms": cold_ms,
        "1994 deadline over cold zone": factor,
        f"zones built by {CONCURRENT} first requests at once": built,
        "identify, median us": statistics.median(identify),
        "solve, median us": statistics.median(solve),
        "whole pipeline, median us": statistics.median(whole),
        "identify and solve in empty compiled calls": both / empty_us,
        PLAIN: plain_us / statistics.median(whole),
        HELD: sum(judge.comparison.outcomes.values()),
        "stars that differ": len(judge.comparison.differences),
    }
    differ = judge.comparison.differences
    bounds = [
        at_least("1994 deadline over cold zone", factor, DEADLINE_FACTOR),
        equal(f"zones built by {CONCURRENT} first requests at once", built, 1),
        at_most("identify and solve together, median", both, BOUND_US[kind], "µs"),
        at_most("whole pipeline, median", statistics.median(whole), WHOLE_US[kind], "µs"),
        at_most("identify and solve in empty compiled calls", both / empty_us, EMPTY_CALLS[kind]),
        at_least(PLAIN, figures[PLAIN], LEAST_OVER_PLAIN),
        at_least(HELD, figures[HELD], 4 * count),
        Bound("stars that differ", "; ".join(map(str, differ[:5])) or "0", "0", not differ),
    ]
    return Place(figures, bounds)


def _cold(batch: ObservationBatch, judge: Judge, sky: SkyModel) -> tuple[float, int]:
    """Milliseconds of a first answer without its zone, and zones built by parallel requests."""
    times = []
    for _ in range(3):
        fresh = SkyModel(sky.catalog, LruCache(MEGABYTES_256))
        fresh.run_catalog(judge.mission, batch.time)
        started = time.perf_counter()
        acquire(batch, judge.mission, fresh)
        times.append((time.perf_counter() - started) * 1000)
    fresh = SkyModel(sky.catalog, LruCache(MEGABYTES_256))
    fresh.run_catalog(judge.mission, batch.time)
    with ThreadPoolExecutor(CONCURRENT) as pool:
        list(pool.map(lambda _: acquire(batch, judge.mission, fresh), range(CONCURRENT)))
    return statistics.median(times), fresh.cache.state().misses - 1


def _empty_call_us(zone: Any) -> float:
    votes = np.zeros((5, len(zone.star)), np.int32)
    pairs = zone.pairs
    arrays = (zone.direction, zone.magnitude_mag, pairs.separation_rad, pairs.brighter)
    nothing(*arrays, pairs.dimmer, votes)
    started = time.perf_counter_ns()
    for _ in range(1000):
        nothing(*arrays, pairs.dimmer, votes)
    return (time.perf_counter_ns() - started) / 1e6
