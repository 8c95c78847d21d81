"""QUEST and TRIAD against a singular value decomposition, over a million random cases."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import at_most, between, equal
from benchmarks.record import CORE
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.vectors import ARCSEC_PER_RADIAN
from tests.reference.attitude_by_svd import Agreement, Array, agreement, random_cases

CASES = 1_000_000
QUICK_CASES = 20_000
BLOCK = 5_000
MOST_IN_SIGMA, MOST_MEDIAN_ARCSEC = 0.01, 1e-6
TRIAD, TRIAD_OFF = "TRIAD off in sigma, median", (0.1, 2.0)


def blocks(count: int) -> Iterator[tuple[str, int, int]]:
    """Kinds, numbers of stars, and sizes of blocks with `count` cases in total."""
    kinds = [
        (kind, n) for kind in ("half_turn", "narrow", "unequal", "wide") for n in (2, 3, 5, 12)
    ]
    done, turn = 0, 0
    while done < count:
        size = min(BLOCK, count - done, max(1, count // len(kinds)))
        kind, stars = kinds[turn % len(kinds)]
        yield kind, stars, size
        done, turn = done + size, turn + 1


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the differences: worst, distribution, and bounds."""
    rng = np.random.default_rng(seed)
    count = QUICK_CASES if quick else CASES
    parts: list[tuple[str, int, Agreement]] = []
    with tqdm(total=count, desc="attitude against SVD", unit="case") as bar:
        for kind, stars, size in blocks(count):
            parts.append((kind, stars, agreement(random_cases(rng, size, stars, kind))))
            bar.update(size)
    report = summary(parts)
    triad = between("TRIAD off in sigma, median", report.figures[TRIAD], *TRIAD_OFF)
    return replace(report, bounds=[*report.bounds, triad])


def summary(parts: list[tuple[str, int, Agreement]]) -> Report:
    def joined(name: str) -> Array:
        return np.concatenate([getattr(part, name) for _, _, part in parts])

    apart, bound, sigma = joined("apart_rad"), joined("bound_rad"), joined("sigma_rad")
    share = apart / bound
    in_sigma = apart / sigma
    arcsec = apart * ARCSEC_PER_RADIAN
    wrongly = sum(part.wrongly_refused for _, _, part in parts)
    figures: dict[str, Any] = {
        "cases": sum(part.cases for _, _, part in parts),
        "refused for their geometry": sum(part.refused for _, _, part in parts),
        "refused without cause": wrongly,
        "solved cases out of bounds": int(np.count_nonzero(share > 1.0)),
        "difference in arcsec, median": float(np.median(arcsec)),
        "difference in arcsec, 99.9 %": float(np.quantile(arcsec, 0.999)),
        "difference in arcsec, worst": float(arcsec.max()),
        "difference as a share of sigma, worst": float(in_sigma.max()),
        "difference as a share of its bound, worst": float(share.max()),
        TRIAD: float(np.median(joined("triad_apart_rad") / sigma)),
    }
    for kind in dict.fromkeys(kind for kind, _, _ in parts):
        worst = max(
            float(part.apart_rad.max(initial=0.0)) for name, _, part in parts if name == kind
        )
        figures[f"worst of {kind.replace('_', ' ')}, arcsec"] = worst * ARCSEC_PER_RADIAN
    bounds = [
        equal("refused without cause", wrongly, 0),
        equal("solved cases out of bounds", int(np.count_nonzero(share > 1.0)), 0),
        at_most("difference as a share of its bound, worst", float(share.max()), 1.0),
        at_most("difference as a share of sigma, worst", float(in_sigma.max()), MOST_IN_SIGMA),
        at_most("difference, median", float(np.median(arcsec)), MOST_MEDIAN_ARCSEC, "arcsec"),
    ]
    return Report("attitude_against_svd", figures, bounds)


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about attitudes."""
    report = run(quick, seed)
    text = f"""
QUEST beside the attitude of a singular value decomposition, which needs no iteration: exact half
turns about any axis, fields from a twentieth of a degree to the whole sky, 2 to 12 stars, sigmas up
to four decades apart. The bound of each case is thirty roundings times the condition of its
geometry, which is what the decomposition itself can hold.

{table(("", "figure"), report.figures.items())}
"""
    return Written(text, report.bounds)


SECTION = Section("Attitude", write, (*CORE, "tests/reference"))
