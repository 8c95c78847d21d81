"""Many batches as columns against the same batches one by one, in one run, with equal answers.

    python -m benchmarks columns

Nominal batches of five stars, verified, about a priori attitudes of one place in a cap and in
a band.  Times are of the processor, the least of several rounds in which both take turns.
"""

import json
import math
import statistics
import time
import tomllib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.report import Report
from benchmarks.speed.pipeline import MEGABYTES_256
from service.acquire import Acquisition, BatchColumns, acquire, acquire_many
from service.missions.mission import load_missions
from service.observations.batch import ObservationBatch
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.recording.answer import answer_of
from tests.missions.stated_files import STATED_FOLDER
from tests.reference import batches
from tests.reference.compare import Judge

BATCHES, QUICK_BATCHES = 10_000, 1_000
ROUNDS = 4
LEAST_A_SECOND = {"XTE": 20_000.0, "SOHO": 6_000.0}
MOST_ONE_US = {"XTE": 150.0, "SOHO": 220.0}


def run(quick: bool, seed: int) -> Report:
    """Benchmark of columns with a cap and with a band."""
    sky = SkyModel(load_embedded(), LruCache(MEGABYTES_256))
    figures: dict[str, Any] = {}
    bounds: list[Bound] = []
    for name in LEAST_A_SECOND:
        drawn = nominal(name, QUICK_BATCHES if quick else BATCHES, seed, sky)
        found, held = measured(name, drawn, sky)
        figures |= {f"{name}: {figure}": value for figure, value in found.items()}
        bounds += [replace(each, figure=f"{name}: {each.figure}") for each in held]
    return Report("columns", figures, bounds)


def measured(
    name: str, drawn: list[ObservationBatch], sky: SkyModel
) -> tuple[dict[str, Any], list[Bound]]:
    """Figures and bounds of one mission."""
    mission = load_missions()[name]
    columns, few = BatchColumns.of(drawn), drawn[: len(drawn) // 10]
    found = acquire_many(columns, mission, sky)
    differ = sum(
        _answer(found.acquisition(row)) != _answer(acquire(batch, mission, sky))
        for row, batch in enumerate(few)
    )

    def one_by_one() -> None:
        for batch in few:
            started = time.thread_time_ns()
            acquire(batch, mission, sky)
            ones.append((time.thread_time_ns() - started) / 1000)

    works: dict[str, tuple[Callable[[], object], int]] = {
        "one by one": (one_by_one, len(few)),
        "by columns": (lambda: acquire_many(columns, mission, sky), len(drawn)),
        "packed": (lambda: BatchColumns.of(drawn), len(drawn)),
        "rows": (lambda: [found.acquisition(row) for row in range(len(few))], len(few)),
    }
    spent, ones, medians = dict.fromkeys(works, math.inf), list[float](), list[float]()
    for _ in range(ROUNDS):
        ones.clear()
        for part, (work, count) in works.items():
            started = time.thread_time_ns()
            work()
            spent[part] = min(spent[part], (time.thread_time_ns() - started) / 1000 / count)
        medians.append(statistics.median(ones))
    rate, before = 1e6 / spent["by columns"], 1e6 / spent["one by one"]
    figures = {
        "one by one, batches a second": before,
        "by columns, batches a second": rate,
        "by columns over one by one": rate / before,
        "packed from batches, us each": spent["packed"],
        "a row as an acquisition, us each": spent["rows"],
        "one by itself, median us": min(medians),
        f"finished by themselves of {len(drawn)}": len(found.finished),
    }
    return figures, [
        at_least("by columns, batches a second", rate, LEAST_A_SECOND[name]),
        at_most("one by itself, median", min(medians), MOST_ONE_US[name], "µs"),
        equal(f"answers that differ of {len(few)}", differ, 0),
    ]


def nominal(name: str, count: int, seed: int, sky: SkyModel) -> list[ObservationBatch]:
    """Batches of five real stars about one slightly wrong a priori attitude."""
    toml = tomllib.loads((STATED_FOLDER / f"{name.lower()}.toml").read_text("utf-8"))
    judge, rng, moment = Judge(toml, sky), np.random.default_rng(seed), batches.TIMES[1]
    attitude = batches.prior_attitudes(rng, toml, 3)[2]
    bodies = [
        batches.draw_batch(
            *(rng, toml, judge.catalog(moment), attitude, number),
            prior="quaternion",
            error_deg=3.0 if toml["zone"]["kind"] == "cap" else 0.1,
            stars=5,
            spurious=0,
            missing=0.0,
            noise_arcsec=2.1,
            magnitude_noise=0.1,
            time=moment,
        )
        for number in range(count)
    ]
    return [submission_from_json(json.dumps(body | {"options": {}})).batch for body in bodies]


def _answer(acquisition: Acquisition) -> bytes:
    """Answer as JSON bytes without times and cache state."""
    answer = msgspec.to_builtins(answer_of(acquisition, id=None))
    del answer["timings_us"]
    for each in answer["observations"]:
        each["zone"].pop("cached", None)
    return msgspec.json.encode(answer)
