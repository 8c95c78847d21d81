"""What aberration does to an attitude, three ways: corrected, applied upstream, ignored."""

from typing import Any

import numpy as np

from benchmarks.covariance import Passes, error_of
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.sky.catalog import load_embedded
from service.sky.shelf import Shelf
from service.sky.view import Sky
from service.vectors import ARCSEC_PER_RADIAN
from tests.reference import batches

BATCHES, QUICK_BATCHES = 300, 60

# How the stars are sent, what the batch says of them, and whether the attitude is then right.
WAYS = {
    "corrected here": (True, "to_correct", True),
    "applied upstream": (False, "applied_upstream", True),
    "ignored": (True, "ignore", False),
    "applied twice": (False, "to_correct", False),
}


def run(quick: bool, seed: int) -> Report:
    """Mean pointing error across the boresight, beside the shift that aberration makes there."""
    count = QUICK_BATCHES if quick else BATCHES
    passes = Passes("XTE", Sky(load_embedded(), Shelf(256 << 20)))
    boresight = passes.mission.trackers[0].body_from_tracker[:, 2]
    figures: dict[str, Any] = {}
    faults = []
    for way, (apparent, said, right) in WAYS.items():
        rng = np.random.default_rng(seed)
        priors = batches.prior_attitudes(rng, passes.toml, 20)
        off, shift = [], []
        for _ in range(count):
            prior = priors[rng.integers(len(priors))]
            directions = passes.seen if apparent else passes.directions
            truth, found = passes.draw(rng, prior, directions, said)
            error = error_of(truth, found)
            if error is not None:
                off.append(float(np.linalg.norm(np.cross(error, boresight))))
                across = np.cross(truth.T @ boresight, passes.velocity_c)
                shift.append(float(np.linalg.norm(across)) * ARCSEC_PER_RADIAN)
        here, expected = float(np.mean(off)), 0.0 if right else float(np.mean(shift))
        figures[f"{way}: mean arcsec off (predicted)"] = f"{here:.2f} ({expected:.2f})"
        # Noise alone leaves a good arcsecond, and the centre of the stars is not the boresight.
        if abs(here - expected) > 2.0:
            faults.append(f"{way}: off by {here:.2f} arcsec instead of {expected:.2f}")
    return Report("aberration", figures, not faults, faults)


def write(quick: bool, seed: int) -> Written:
    """The section of the verification."""
    report = run(quick, seed)
    text = f"""
The same batch of an XTE in a low orbit sent four ways. Apparent directions come from a Lorentz
transformation written out in the benchmark. Given is the mean pointing error across the boresight,
and what it should be; noise alone leaves about an arcsecond.

{table(("way: what is shown", "arcsec"), report.figures.items())}
"""
    return Written(text, report.passed)


SECTION = Section("Aberration", write)
