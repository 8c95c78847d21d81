"""Effect of aberration on an attitude in three cases: corrected, applied upstream, ignored."""

import math
from typing import Any

import numpy as np

from benchmarks.bounds import Bound, at_most, between
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written
from benchmarks.validation.covariance import Passes, error_of
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.vectors import ARCSEC_PER_RADIAN
from tests.reference import batches

BATCHES, QUICK_BATCHES = 1000, 60
WITHIN_ARCSEC = 0.5
"""Tolerance of the shift in arcseconds; noise adds a few hundredths to a shift of sixteen."""
SAME_ARCSEC = 0.01
NOISE = 0.15
"""Greatest relative difference of a right attitude's mean error from its covariance."""

# How the stars are sent, what the batch says of them, and whether the attitude is then right.
WAYS = {
    "corrected here": (True, "to_correct", True),
    "applied upstream": (False, "applied_upstream", True),
    "ignored": (True, "ignore", False),
    "applied twice": (False, "to_correct", False),
}


def run(quick: bool, seed: int) -> Report:
    """Benchmark of mean pointing error across the boresight against the shift by aberration."""
    count = count_of(quick)
    passes = Passes("XTE", SkyModel(load_embedded(), LruCache(256 << 20)))
    boresight = passes.mission.trackers[0].body_from_tracker[:, 2]
    figures: dict[str, Any] = {}
    bounds: list[Bound] = []
    lengths: dict[str, list[float]] = {}
    for way, (apparent, said, right) in WAYS.items():
        rng = np.random.default_rng(seed)
        priors = batches.prior_attitudes(rng, passes.toml, 20)
        off, shift, noise = [], [], []
        for number in range(count):
            # A generator per batch, since the ways may draw different numbers of stars at an edge.
            rng = np.random.default_rng([seed, number])
            prior = priors[rng.integers(len(priors))]
            directions = passes.seen if apparent else passes.directions
            truth, found = passes.draw(rng, prior, directions, said)
            error = error_of(truth, found)
            lengths.setdefault(way, []).append(math.nan)
            if error is not None and found.solution is not None:
                off.append(float(np.linalg.norm(np.cross(error, boresight))))
                lengths[way][-1] = off[-1]
                across = np.cross(truth.T @ boresight, passes.velocity_c)
                shift.append(float(np.linalg.norm(across)) * ARCSEC_PER_RADIAN)
                covariance = found.solution.covariance_arcsec2
                across_arcsec2 = np.trace(covariance) - boresight @ covariance @ boresight
                # Rayleigh: the mean length of two Gaussian components alike.
                noise.append(math.sqrt(float(across_arcsec2) * math.pi) / 2.0)
        expected = float(np.mean(noise if right else shift))
        mean = float(np.mean(off))
        figures[f"{way}: mean arcsec off"] = f"{mean:.2f}"
        figures[f"{way}: predicted from {'the covariance' if right else 'the shift'}"] = (
            f"{expected:.2f}"
        )
        within = NOISE * expected * (5.0 if quick else 1.0) if right else WITHIN_ARCSEC
        bounds.append(
            between(f"{way}: mean off", mean, expected - within, expected + within, "arcsec")
        )
    # Batch by batch: a star that only one of both ways matched changes a mean of a few batches.
    here, upstream = (np.array(lengths[way]) for way in ("corrected here", "applied upstream"))
    apart = float(np.nanmedian(np.abs(here - upstream)))
    bounds.append(
        at_most("corrected here and applied upstream apart", apart, SAME_ARCSEC, "arcsec")
    )
    return Report("aberration", figures, bounds)


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about aberration."""
    report = run(quick, seed)
    text = f"""
The same batches of an XTE in a low orbit sent four ways, {count_of(quick):,} each. Apparent
directions come from a Lorentz transformation written out in the benchmark. Given is the mean
pointing error across the boresight. Where aberration is treated rightly, noise alone is left, as
much as the covariance predicts; where it is not, the shift that it makes at the boresight.
"""
    return Written(text, report.bounds)


def count_of(quick: bool) -> int:
    """Number of batches of each case."""
    return QUICK_BATCHES if quick else BATCHES


SECTION = Section("Aberration", write, (*CORE, *SIMULATOR, "benchmarks/validation/covariance.py"))
