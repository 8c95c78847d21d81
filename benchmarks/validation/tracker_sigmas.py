"""Test of the sigmas of a calibration of trackers over many simulated periods.

    python -m benchmarks tracker_sigmas

Two trackers, the second misaligned by 35/-22/80 arcsec, both with a distortion of 10 arcsec rms:
how often the misalignment is within three sigmas of the truth; and the errors of every unknown
over their sigmas, pooled, where scale, time tag and dependence on temperature are unknown too
and the stars' own sigmas are told wrong.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from benchmarks.bounds import at_least, between
from benchmarks.report import Report
from service.features.calibration.estimate import calibrate
from service.features.calibration.linearise import Model
from tests.features.calibration import drawn as simulated
from tests.features.calibration.drawn import MISALIGNED, Truth

Array = npt.NDArray[np.float64]
# Tests have no types.
drawn: Any = simulated.drawn
bending: Any = simulated.bending
everything: Any = simulated.everything
truth_of: Any = simulated.truth_of

MISALIGNMENTS, QUICK_MISALIGNMENTS = 100, 10
POOLED, QUICK_POOLED = 400, 20
BATCHES_OF_MISALIGNMENT, BATCHES_OF_POOLED = 100, 60
TOLD_SIGMA_ARCSEC = 4.0
"""Wrong sigma given to the calibration; the true one is 6 arcsec."""
LEAST_WITHIN = 0.97
SIZE = (0.93, 1.07)
QUICK_SIZE = (0.85, 1.15)


def misalignment_errors(seed: int) -> Array:
    """Errors (3,) of the misalignment of one period, in sigmas."""
    rng = np.random.default_rng([1, seed])
    stars = drawn(rng, BATCHES_OF_MISALIGNMENT, Truth(MISALIGNED, bending(rng)))
    found = calibrate(stars, Model())
    value, sigma = zip(*(found.value_of(f"B alignment {axis}") for axis in "xyz"), strict=True)
    return np.asarray((np.array(value) - MISALIGNED) / np.array(sigma))


def pooled_errors(seed: int) -> Array:
    """Errors (p,) of every unknown of one period, in sigmas."""
    rng = np.random.default_rng([2, seed])
    truth, stars, model = everything(rng, BATCHES_OF_POOLED, told_sigma_arcsec=TOLD_SIGMA_ARCSEC)
    found = calibrate(stars, model)
    return np.asarray((found.value - truth_of(truth, found.unknowns)) / found.sigma)


def run(quick: bool, seed: int) -> Report:
    """Benchmark of both tests over many seeds, from `seed` on."""
    begun_s = time.perf_counter()
    turns, every = (QUICK_MISALIGNMENTS, QUICK_POOLED) if quick else (MISALIGNMENTS, POOLED)
    of_turn = _over("misalignment", misalignment_errors, turns, seed)
    pooled = np.concatenate(_over("all unknowns", pooled_errors, every, seed))
    within = int(np.sum([bool((np.abs(each) < 3.0).all()) for each in of_turn]))
    size = float(np.sqrt(np.mean(pooled**2)))
    figures = {
        "stretches of 100 batches": len(of_turn),
        "misalignment within 3 sigmas about all three axes": within,
        "errors of all unknowns": len(pooled),
        "errors over sigma, rms": size,
        "errors over sigma, share beyond 3": float(np.mean(np.abs(pooled) > 3.0)),
        "errors over sigma, largest": float(np.abs(pooled).max()),
        "time in all, s": time.perf_counter() - begun_s,
    }
    bounds = [
        at_least("misalignments within 3 sigmas, share", within / len(of_turn), LEAST_WITHIN)
        if not quick
        else at_least("misalignments within 3 sigmas", within, len(of_turn) - 1),
        between("errors over sigma, rms", size, *(QUICK_SIZE if quick else SIZE)),
    ]
    return Report("tracker_sigmas", figures, bounds)


def _over(title: str, errors: Callable[[int], Array], count: int, first_seed: int) -> list[Array]:
    seeds = tqdm(range(first_seed, first_seed + count), desc=title, unit="stretch")
    return [errors(seed) for seed in seeds]
