"""Expected identification results of a mission, from simulated views all over the sky.

The views are drawn like telemetry: with the mission's noise and a priori errors.  Every view has
another pointing; those of a Sun-pointed mission are spread over the days of a year.
"""

import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from service.acquire.pipeline import acquired
from service.acquire.result import Acquisition
from service.missions.mission import Band, Mission
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass, usual_stars
from service.simulate.telemetry import DrawnBatch, draw_pass
from service.sky.model import SkyModel
from service.times import DAY_S, Utc, shifted
from service.vectors import from_ra_dec, matrix_from_quaternion

GALACTIC_POLE = from_ra_dec(192.85948, 27.12825)
CLEAR_LATITUDE_DEG, DENSE_LATITUDE_DEG = 30.0, 10.0
"""Galactic latitudes in degrees above which sky counts as clear, and below which as dense."""
VIEWS, AT_ONCE = 400, 20


@dataclass
class Expected:
    """Outcomes of simulated views in one kind of sky, clear or dense."""

    sky: str
    views: int = 0
    attitudes: int = 0
    stars: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(
            ("observed", "unique", "ambiguous", "unmatched", "wrong"), 0
        )
    )

    def share(self, outcome: str) -> float:
        """Share of the observed stars with an outcome, from 0 to 1; NaN without stars."""
        observed = self.stars["observed"]
        return self.stars[outcome] / observed if observed else float("nan")


def expected_outcomes(
    mission: Mission, sky: SkyModel, moment: Utc, seconds: float
) -> list[Expected]:
    """Simulate up to `VIEWS` views, as time allows; returns outcomes in clear and in dense sky.

    `seconds` are of this process's CPU time, after the first views, which may compile kernels.
    """
    found = {"clear": Expected("clear"), "dense": Expected("dense")}
    until = math.inf
    views = _views(mission, sky, moment)
    while chunk := [each for _, each in zip(range(AT_ONCE), views, strict=False)]:
        batches = [submission_from_json(json.dumps(each.batch).encode()).batch for each in chunk]
        for drawn, result in zip(chunk, acquired(batches, mission, sky), strict=True):
            if (kind := _kind(mission, drawn)) is not None and not isinstance(result, Exception):
                _count(found[kind], drawn, result)
        if time.process_time() > until:
            break
        until = min(until, time.process_time() + seconds)
    return [each for each in found.values() if each.views]


def _views(mission: Mission, sky: SkyModel, moment: Utc) -> Iterator[DrawnBatch]:
    step_days = 365.25 / VIEWS if isinstance(mission.zone, Band) else 0.0
    for k in np.random.default_rng(1).permutation(VIEWS).tolist():
        wanted = Pass(
            1,
            VIEWS + k,
            start=shifted(moment, k * step_days * DAY_S).text,
            stars=usual_stars(mission),
            prior="quaternion" if mission.knows_attitude else "none",
            troubles=NO_TROUBLES,
        )
        yield from draw_pass(mission, sky, wanted)


def _kind(mission: Mission, drawn: DrawnBatch) -> str | None:
    attitude = matrix_from_quaternion(drawn.truth["quaternion"])
    boresight = mission.trackers[0].boresight_body @ attitude
    latitude_deg = abs(np.degrees(np.arcsin(np.clip(boresight @ GALACTIC_POLE, -1.0, 1.0))))
    if latitude_deg >= CLEAR_LATITUDE_DEG:
        return "clear"
    return "dense" if latitude_deg <= DENSE_LATITUDE_DEG else None


def _count(expected: Expected, drawn: DrawnBatch, result: Acquisition) -> None:
    expected.views += 1
    expected.attitudes += result.solution is not None and not result.solution.suspect
    for name, count in result.counts.items():
        expected.stars[name] += count
    for truth, tracker in zip(drawn.truth["observations"], result.trackers, strict=True):
        found = tracker.identification
        for true, star, is_unique in zip(truth["stars"], found.star, found.unique, strict=True):
            is_wrong = is_unique and result.run_catalog.star_id[star] != true
            expected.stars["wrong"] += bool(is_wrong)
