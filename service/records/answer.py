"""The answer to a batch, as the interface shows it and as it is recorded."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from service.acquire import Acquisition, TrackerResult
from service.attitude.solution import AttitudeSolution
from service.identify.identification import Outcome
from service.sky.run_catalog import RunCatalog
from service.sky.zones import Aim
from service.vectors import Vector, to_ra_dec

FRAME = "EME2000"


@dataclass(frozen=True)
class StarRow:
    """What is kept of one observed star."""

    tracker: str
    position: int
    outcome: str
    star_id: str | None
    votes: int
    runner_up: int
    probability: float | None
    residual_arcsec: float | None


def answer_of(
    acquisition: Acquisition,
    *,
    id: str | None,
    parent: str | None = None,
) -> dict[str, Any]:
    """The answer, ready for JSON; `id` is None for what is not recorded.

    The time of recording stays None: it is known when the rows are handed over.
    """
    batch, provenance = acquisition.batch, acquisition.provenance
    answer: dict[str, Any] = {
        "id": id,
        "spacecraft": batch.spacecraft,
        "batch": batch.batch,
        "run": batch.run,
        "time": batch.time.text,
        "identifier": acquisition.choices.identifier,
        "path": str(acquisition.path),
        "observations": [
            _tracker_answer(each, acquisition.run_catalog) for each in acquisition.trackers
        ],
        "counts": acquisition.counts,
        "attitude": None if acquisition.solution is None else _attitude(acquisition.solution),
        "reason": None if acquisition.reason is None else str(acquisition.reason),
        "warnings": list(acquisition.warnings),
        "timings_us": {**acquisition.timings_us, "record": None},
        "provenance": {
            "catalog": provenance.catalog,
            "run_catalog": provenance.run_catalog,
            "epoch_year": provenance.epoch_year,
            "mission": provenance.mission,
            "version": provenance.version,
        },
    }
    if parent is not None:
        answer["parent"] = parent
    return answer


def star_rows(acquisition: Acquisition) -> list[StarRow]:
    """Every star of every tracker, in the order observed."""
    return [
        StarRow(
            tracker=each.corrected.tracker.name,
            position=k,
            outcome=Outcome(outcome).word,
            star_id=_star_id(acquisition.run_catalog, int(each.identification.star[k])),
            votes=int(each.identification.votes[k]),
            runner_up=int(each.identification.runner_up[k]),
            probability=_number(each.identification.probability[k]),
            residual_arcsec=_number(each.residual_arcsec[k]),
        )
        for each in acquisition.trackers
        for k, outcome in enumerate(each.identification.outcome)
    ]


def _tracker_answer(result: TrackerResult, run_catalog: RunCatalog) -> dict[str, Any]:
    tracker, found = result.corrected.tracker, result.identification
    return {
        "tracker": tracker.name,
        "zone": None if result.aim is None else _zone(result, result.aim),
        "stars": [_star(result, k, run_catalog) for k in range(len(found.outcome))],
    }


def _zone(result: TrackerResult, aim: Aim) -> dict[str, Any]:
    ra_deg, dec_deg = to_ra_dec(aim.axis)
    return {
        "kind": aim.kind,
        "ra_deg": float(ra_deg),
        "dec_deg": float(dec_deg),
        "stars": result.stars,
        "pairs": result.pairs,
        "cached": result.zone_cached,
    }


def _star(result: TrackerResult, k: int, run_catalog: RunCatalog) -> dict[str, Any]:
    found = result.identification
    outcome = Outcome(found.outcome[k])
    name = _star_id(run_catalog, int(found.star[k]))
    star: dict[str, Any] = {
        "outcome": outcome.word,
        "star": None if name is None else {"catalog": name.partition(" ")[0], "id": name},
        "votes": int(found.votes[k]),
        "runner_up": int(found.runner_up[k]),
    }
    if outcome is Outcome.AMBIGUOUS or found.rivals[k]:
        star["rivals"] = [_star_id(run_catalog, rival) for rival in found.rivals[k]]
        if found.rival_probability:
            star["rival_probabilities"] = list(found.rival_probability[k])
    star["probability"] = _number(found.probability[k])
    star["residual_arcsec"] = _number(result.residual_arcsec[k])
    star["flags"] = _flags(result, k)
    return star


def _flags(result: TrackerResult, k: int) -> list[str]:
    flags = []
    if result.corrected.outside_field_of_view[k]:
        flags.append("outside_field_of_view")
    if np.isnan(result.corrected.magnitude_mag[k]):
        flags.append("no_magnitude")
    star = result.identification.star
    if star[k] >= 0 and np.count_nonzero(star == star[k]) > 1:
        flags.append("same_star_twice")
    return flags


def _attitude(solution: AttitudeSolution) -> dict[str, Any]:
    attitude: dict[str, Any] = {
        "quaternion": solution.quaternion.tolist(),
        "frame": FRAME,
        "covariance_arcsec2": solution.covariance_arcsec2.tolist(),
        "method": solution.method,
        "residual_rms_arcsec": solution.residual_rms_arcsec,
        "predicted_rms_arcsec": solution.predicted_rms_arcsec,
        "taste": solution.taste,
        "degrees_of_freedom": solution.degrees_of_freedom,
        "status": "suspect" if solution.suspect else "good",
        "triad": solution.triad.tolist(),
        "quest": solution.quest.tolist(),
        "triad_quest_angle_arcsec": solution.triad_quest_angle_arcsec,
    }
    if solution.trackers:
        attitude["trackers"] = [
            {"tracker": fit.tracker, "stars": fit.stars, "taste": fit.taste, "outlier": fit.outlier}
            for fit in solution.trackers
        ]
        attitude["outlier"] = next((fit.tracker for fit in solution.trackers if fit.outlier), None)
    return attitude


def _star_id(run_catalog: RunCatalog, row: int) -> str | None:
    return None if row < 0 else str(run_catalog.star_id[row])


def _number(value: float | Vector) -> float | None:
    number = float(value)
    return None if np.isnan(number) else number
