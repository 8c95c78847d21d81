"""Answer to a batch: its form in the interface and its rows in the database."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET, Struct, UnsetType, structs

from service.acquire import Acquisition
from service.acquire.result import RivalAttitude, TrackerResult
from service.contract import answers
from service.identify.identification import Outcome
from service.observations.batch import PredictedPrior
from service.sky.catalog.run_catalog import RunCatalog
from service.vectors import ra_dec_of

FRAME = "EME2000"
WORDS = {int(outcome): outcome.word for outcome in Outcome}
_AMBIGUOUS = int(Outcome.AMBIGUOUS)


class StarRow(NamedTuple):
    """Row of one observed star and its identification."""

    tracker: str
    position: int
    outcome: str
    star_id: str | None
    residual_arcsec: float | None


def answer_of(
    acquisition: Acquisition,
    *,
    id: str | None,
    parent: str | UnsetType = UNSET,
    recorded: bool | UnsetType = UNSET,
    frame: answers.FrameSummary | UnsetType = UNSET,
    warnings: Sequence[str] = (),
) -> answers.Answer:
    """Build the answer to a batch; `id` is None if nothing is recorded.

    `warnings` follow those of the acquisition.  The time that recording takes stays None until the
    result is handed to the writer.
    """
    batch, run_catalog = acquisition.batch, acquisition.run_catalog
    return answers.Answer(
        id=id,
        spacecraft=batch.spacecraft,
        batch=batch.batch,
        run=batch.run,
        time=batch.time.text,
        identifier=acquisition.choices.identifier,
        path=str(acquisition.path),
        observations=[_tracker_answer(each, run_catalog) for each in acquisition.trackers],
        counts=answers.StarCounts(**acquisition.counts),
        attitude=_attitude(acquisition),
        reason=None if acquisition.reason is None else str(acquisition.reason),
        warnings=[*acquisition.warnings, *warnings],
        timings_us=answers.Timings(**acquisition.timings_us, record=None),
        provenance=answers.Provenance(**structs.asdict(acquisition.provenance)),
        parent=parent,
        recorded=recorded,
        frame=frame,
        tracking=_tracking(acquisition),
    )


def star_rows(acquisition: Acquisition) -> list[StarRow]:
    """Rows of all stars of every tracker, in the order observed."""
    return [
        StarRow(
            tracker=each.corrected.tracker.name,
            position=k,
            outcome=Outcome(outcome).word,
            star_id=_star_id(acquisition.run_catalog, int(each.identification.star[k])),
            residual_arcsec=_number(float(each.residual_arcsec[k])),
        )
        for each in acquisition.trackers
        for k, outcome in enumerate(each.identification.outcome)
    ]


def rows_of_stars(answer: answers.Answer) -> list[dict[str, Any]]:
    """Convert every star of an answer to a row of the table `star_results`."""
    return [
        {
            "result_id": answer.id,
            "tracker": tracker.tracker,
            "position": position,
            "outcome": star.outcome,
            "star_id": star.star and star.star.id,
            "votes": star.votes,
            "runner_up": star.runner_up,
            "probability": star.probability,
            "residual_arcsec": star.residual_arcsec,
        }
        for tracker in answer.observations
        for position, star in enumerate(tracker.stars)
    ]


def _tracker_answer(result: TrackerResult, run_catalog: RunCatalog) -> answers.TrackerStars:
    region, zone = result.region, None
    if region is not None:
        ra_deg, dec_deg = ra_dec_of(region.axis)
        zone = answers.SearchedZone(
            kind=region.kind,
            ra_deg=ra_deg,
            dec_deg=dec_deg,
            stars=result.stars,
            pairs=result.pairs,
            cached=result.zone_cached,
        )
    stars = _stars(result, run_catalog)
    return answers.TrackerStars(tracker=result.corrected.tracker.name, zone=zone, stars=stars)


def _stars(result: TrackerResult, run_catalog: RunCatalog) -> list[answers.Star]:
    found, seen = result.identification, result.corrected
    # Convert arrays to plain numbers at once: taking single elements out costs more than the rest.
    rows = found.star.tolist()
    columns = zip(
        found.outcome.tolist(),
        rows,
        found.votes.tolist(),
        found.runner_up.tolist(),
        found.probability.tolist(),
        result.residual_arcsec.tolist(),
        seen.outside_field_of_view.tolist(),
        seen.magnitude_mag.tolist(),
        strict=True,
    )
    stars = []
    for k, (outcome, row, votes, second, probability, residual, outside, mag) in enumerate(columns):
        name = _star_id(run_catalog, row)
        rivals: Any = UNSET
        rival_probabilities: Any = UNSET
        if outcome == _AMBIGUOUS or found.rivals[k]:
            rivals = [_star_id(run_catalog, rival) for rival in found.rivals[k]]
            if found.rival_probability:
                rival_probabilities = list(found.rival_probability[k])
        flags = ["outside_field_of_view"] if outside else []
        # NaN does not equal itself, and is no JSON number.
        if mag != mag:
            flags.append("no_magnitude")
        if row >= 0 and rows.count(row) > 1:
            flags.append("same_star_twice")
        stars.append(
            answers.Star(
                outcome=WORDS[outcome],
                star=None
                if name is None
                else answers.StarRef(catalog=name.partition(" ")[0], id=name),
                votes=votes,
                runner_up=second,
                rivals=rivals,
                rival_probabilities=rival_probabilities,
                probability=probability if probability == probability else None,
                residual_arcsec=residual if residual == residual else None,
                flags=flags,
            )
        )
    return stars


def _attitude(acquisition: Acquisition) -> answers.Attitude | None:
    solution, rival = acquisition.solution, acquisition.rival
    if solution is None:
        return None
    several, has_stars = solution.trackers, len(solution.residual_arcsec) > 0
    return answers.Attitude(
        quaternion=solution.quaternion.tolist(),
        frame=FRAME,
        covariance_arcsec2=solution.covariance_arcsec2.tolist(),
        method=solution.method,
        residual_rms_arcsec=_number(solution.residual_rms_arcsec),
        predicted_rms_arcsec=_number(solution.predicted_rms_arcsec),
        taste=_number(solution.taste),
        degrees_of_freedom=solution.degrees_of_freedom,
        status="suspect" if solution.suspect else "good",
        triad=solution.triad.tolist() if has_stars else None,
        quest=solution.quest.tolist() if has_stars else None,
        triad_quest_angle_arcsec=_number(solution.triad_quest_angle_arcsec),
        trackers=[
            answers.TrackerFit(
                tracker=fit.tracker, stars=fit.stars, taste=fit.taste, outlier=fit.outlier
            )
            for fit in several
        ]
        if several
        else UNSET,
        outlier=next((fit.tracker for fit in several if fit.outlier), None) if several else UNSET,
        rival=UNSET if rival is None else _rival(rival, acquisition.run_catalog),
    )


def _tracking(acquisition: Acquisition) -> answers.Tracking | UnsetType:
    asked = acquisition.batch.tracking
    if asked is None:
        return UNSET
    state = acquisition.tracking_state
    assert state is not None
    predicted = acquisition.batch.a_priori
    prediction = None
    if isinstance(predicted, PredictedPrior):
        prediction = answers.Prediction(
            quaternion=predicted.quaternion.tolist(),
            covariance_arcsec2=predicted.covariance_arcsec2.tolist(),
            margin_deg=predicted.margin_deg,
            result=asked.result,
            age_s=asked.age_s,
            rate=asked.rate,
        )
    return answers.Tracking(
        state=state, by_default=asked.by_default, prediction=prediction, reason=asked.reason
    )


def _rival(rival: RivalAttitude, run_catalog: RunCatalog) -> answers.Rival:
    return answers.Rival(
        quaternion=rival.solution.quaternion.tolist(),
        covariance_arcsec2=rival.solution.covariance_arcsec2.tolist(),
        probability=rival.probability,
        angle_deg=rival.angle_deg,
        stars=[[_star_id(run_catalog, row) for row in rows.tolist()] for rows in rival.star],
    )


def _star_id(run_catalog: RunCatalog, row: int) -> str | None:
    return None if row < 0 else run_catalog.star_id[row]


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


class _State(Struct):
    state: str | None = None


class _Tracked(Struct):
    """The part of an answer that gives the state of tracking."""

    tracking: _State | None = None


_TRACKED = msgspec.json.Decoder(_Tracked)


def state_in(answer: str | bytes) -> str | None:
    """Tracking state in an answer; None if the batch did not ask for the last attitude."""
    tracking = _TRACKED.decode(answer).tracking
    return None if tracking is None else tracking.state
