"""Service against the plain implementation at full size, with batches of every kind.

Priors, switches, tolerances, grids, noise, serious errors, spurious stars,
missing magnitudes and several trackers are drawn at random; outcome, star,
votes, runner-up and rivals must be equal for every star.
"""

import tomllib
from collections import Counter
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, equal, every
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from tests.missions.stated_files import STATED_FOLDER
from tests.reference.batches import with_trackers
from tests.reference.compare import Judge

BATCHES, QUICK_BATCHES = 2000, 100
BLOCK = 50
LEAST_OF_EACH = 0.02
"""Least share of unique, ambiguous and unmatched stars, so that all outcomes are compared."""


def run(quick: bool, seed: int) -> Report:
    """Benchmark of all shipped missions, and a tenth as many batches of three trackers."""
    count = QUICK_BATCHES if quick else BATCHES
    sky = SkyModel(load_embedded(), LruCache(256 << 20))
    shipped = [
        tomllib.loads(path.read_text("utf-8")) for path in sorted(STATED_FOLDER.glob("*.toml"))
    ]
    jobs = [(toml["name"], toml, count) for toml in shipped]
    jobs += [
        (f"{toml['name']} with three trackers", with_trackers(toml, 3), count // 10)
        for toml in shipped
    ]
    figures: dict[str, Any] = {}
    outcomes: Counter[str] = Counter()
    sets: list[Bound] = []
    with tqdm(total=sum(job[2] for job in jobs), desc="plain reference", unit="batch") as bar:
        for name, toml, size in jobs:
            # Missions of one zone would otherwise be given the same batches.
            rng = np.random.default_rng([seed, *name.encode()])
            judge = Judge(toml, sky)
            for done in range(0, size, BLOCK):
                part = min(BLOCK, size - done)
                judge.hold_many(rng, part)
                bar.update(part)
            stars, differ = judge.comparison.outcomes, judge.comparison.differences
            shares = ", ".join(f"{stars[k]:,} {k}" for k in ("unique", "ambiguous", "unmatched"))
            figures[name] = f"{size:,} batches, {shares}; {len(differ)} differ"
            if differ:
                figures[f"{name}, first that differ"] = "; ".join(map(str, differ[:5]))
            sets.append(equal(f"{name}: stars that differ", len(differ), 0))
            outcomes += stars
    counts = [outcomes[outcome] for outcome in ("unique", "ambiguous", "unmatched")]
    least = min(counts) / sum(counts)
    bounds = every("sets of batches in which no star differs", sets)
    bounds.append(at_least("rarest outcome, share of all stars", least, LEAST_OF_EACH))
    return Report("plain_reference", figures, bounds)


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about the plain implementation."""
    report = run(quick, seed)
    text = f"""
A second implementation of the votes stands in `tests/reference/plain_starid.py`. It was written
from the paper and the description of a batch alone, has no index, no cache and no compiled code,
and looks at every pair of the exact zone. Batches of every kind are given to both: all kinds of a
priori knowledge, tests on and off in every combination, changed tolerances and grids, serious
errors, spurious stars, missing magnitudes, body rates, several trackers. Outcome, star, votes,
runner-up and rivals must be equal for every star.

{table(("mission", "compared"), report.figures.items())}
"""
    return Written(text, report.bounds)


SECTION = Section("Identification by votes", write)
