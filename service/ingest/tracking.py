"""Prediction of the attitude for a batch that asks for the last attitude in the record.

It becomes part of the recorded batch, so that the batch explains its answer whatever is recorded
later.
"""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from msgspec import structs
from sqlalchemy import BigInteger, Connection, bindparam, select

from service.attitude import prediction
from service.attitude.prediction import Known
from service.errors import BadInput
from service.gyro.samples import BIAS_SIGMAS, believed, gyro_samples, turns_beside_bias
from service.interpolation import QUARTER_TURN_RAD, steps_between
from service.missions.mission import Mission
from service.missions.motion import GyroSettings, MotionSettings, TrackingSettings
from service.observations.batch import ObservationBatch
from service.observations.decode import RECORDED_RATES
from service.observations.schema import NoPrediction, RateSource, Submission, submission_from_json
from service.storage.gyro import BlockFilter, gyro_in
from service.storage.queries.pages import COVARIANCE, PLACE, QUATERNION, covariance_of
from service.storage.recording.results import last_good_results
from service.storage.recording.unsaved_result import PredictedFrom
from service.storage.sql.tables import batches, results, solutions
from service.times import Utc, recorded_utc, shifted
from service.vectors import ARCSEC_PER_RADIAN, Vector

MARGIN_SIGMAS = 3.0
"""Margin of a zone beyond the field of view, in sigmas of the prediction."""
LARGEST_SIGMAS = 5.0
"""Largest rate derived from two attitudes that is believed, in sigmas of the mission's rate."""
SAMPLES_BEFORE_S = 60.0
"""Seconds before the attitude from which gyro samples are read, to cover the first step."""

_LAST = (
    select(
        *(results.c.id, batches.c.time, batches.c.time_ns, batches.c.input),
        *(solutions.c[name] for name in (*QUATERNION, *COVARIANCE)),
    )
    .join_from(results, batches, results.c.batch_id == batches.c.id)
    .join(solutions, solutions.c.result_id == results.c.id)
    .where(
        results.c.current,
        results.c.spacecraft == bindparam("spacecraft"),
        results.c.run == bindparam("run"),
        results.c.time_ns <= bindparam("until_ns", type_=BigInteger),
        results.c.time_ns >= bindparam("since_ns", type_=BigInteger),
        results.c.status == "good",
    )
    .order_by(*(column.desc() for column in PLACE))
    .limit(2)
)


@dataclass(frozen=True, eq=False)
class RecordedAttitude:
    """Recorded good attitude, with its result and the rates (3,) in its batch."""

    result: str
    time: Utc
    known: Known
    body_rates_deg_per_s: Vector


def last_attitudes(
    connection: Connection, spacecraft: str, run: str, until: Utc, within_s: float
) -> list[RecordedAttitude]:
    """The last two good attitudes up to a time and no older than `within_s`, latest first.

    Suspect attitudes are left out.
    """
    asked = {
        "spacecraft": spacecraft,
        "run": run,
        "until_ns": until.tai_ns,
        "since_ns": until.tai_ns - round(within_s * 1e9),
    }
    found = []
    for row in connection.execute(_LAST, asked):
        covariance = np.array(covariance_of(row[8:]))
        known = Known(row.time_ns, np.array(row[4:8]), covariance / ARCSEC_PER_RADIAN**2)
        rates = np.array(RECORDED_RATES.decode(row.input).body_rates_deg_per_s or np.zeros(3))
        found.append(RecordedAttitude(row.id, recorded_utc(row.time), known, rates))
    return found


def predicted_from(
    connection: Connection, batch: ObservationBatch, mission: Mission
) -> PredictedFrom:
    """Find the results whose attitudes start the prediction of a batch."""
    settings = mission.tracking or TrackingSettings()
    until_ns = batch.time.tai_ns
    since_ns = until_ns - round(settings.max_age_s * 1e9)
    period = PredictedFrom(batch.spacecraft, batch.run, since_ns, until_ns, ())
    return structs.replace(period, results=last_good_results(connection, period))


def with_prediction(
    connection: Connection, submission: Submission, mission: Mission, gyro_run: str | None = None
) -> Submission:
    """Add a prediction to the batch of a submission, or the reason why there is none.

    The fingerprint stays that of the batch as sent.  Gyro data are those of `gyro_run`, by default
    of the batch's own run.
    """
    batch = submission.batch
    a_priori: dict[str, Any] = {"from": "last"}
    if batch.tracking is None:
        a_priori["by_default"] = True
    a_priori["prediction"] = _prediction(connection, batch, mission, gyro_run or batch.run)
    body = json.loads(submission.text) | {"a_priori": a_priori}
    made = submission_from_json(json.dumps(body))
    return structs.replace(submission, batch=made.batch, text=made.text)


def tracked_again(
    connection: Connection, submission: Submission, mission: Mission, gyro_run: str
) -> Submission:
    """Copy a recorded batch to another run, with a prediction from that run's last attitude.

    The prediction replaces any a priori knowledge.  Without a prediction, knowledge that was sent
    with the batch stays.  A batch without stars is left unchanged.
    """
    if submission.batch.measurement is not None:
        return submission
    body = json.loads(submission.text)
    prior = body.get("a_priori") or {}
    was_tracked = prior.get("from") == "last"
    asked = None if prior.get("by_default") else {"from": "last"}
    anew = submission_from_json(json.dumps(body | {"a_priori": asked}))
    made = with_prediction(connection, anew, mission, gyro_run)
    assert made.batch.tracking is not None
    is_nothing_else = was_tracked or not prior
    return made if is_nothing_else or made.batch.tracking.reason is None else submission


def _prediction(
    connection: Connection, batch: ObservationBatch, mission: Mission, gyro_run: str
) -> dict[str, Any]:
    settings = mission.tracking or TrackingSettings()
    attitudes = last_attitudes(
        connection, batch.spacecraft, batch.run, batch.time, settings.max_age_s
    )
    if not attitudes:
        return _nothing("no_good_attitude")
    last = attitudes[0]
    if any(flip.lies_between(last.time, batch.time) for flip in settings.flips):
        return _nothing("flip")
    before = attitudes[1] if len(attitudes) > 1 else None
    if before and any(flip.lies_between(before.time, last.time) for flip in settings.flips):
        before = None
    predicted, source = _predicted(connection, batch, mission, last, before, gyro_run)
    floor_rad = math.radians(settings.floor_deg) / MARGIN_SIGMAS
    covariance_rad2 = predicted.covariance_rad2 + np.eye(3) * floor_rad**2
    sigma_deg = math.degrees(math.sqrt(float(np.linalg.eigvalsh(covariance_rad2)[-1])))
    if sigma_deg > settings.ceiling_deg:
        return _nothing("too_uncertain")
    return {
        "quaternion": predicted.quaternion.tolist(),
        "covariance_arcsec2": (covariance_rad2 * ARCSEC_PER_RADIAN**2).tolist(),
        "margin_deg": min(MARGIN_SIGMAS * sigma_deg, settings.ceiling_deg),
        "result": last.result,
        "age_s": (batch.time.tai_ns - last.known.tai_ns) * 1e-9,
        "rate": source,
    }


def _nothing(reason: NoPrediction) -> dict[str, Any]:
    return {"reason": reason}


def _predicted(
    connection: Connection,
    batch: ObservationBatch,
    mission: Mission,
    last: RecordedAttitude,
    before: RecordedAttitude | None,
    gyro_run: str,
) -> tuple[prediction.Known, RateSource]:
    """Predict the attitude at the batch's time: by recorded gyro data, else at a constant rate."""
    now_ns = batch.time.tai_ns
    motion = mission.motion or MotionSettings()
    by_gyro = _by_gyro(connection, batch, mission, last, before, gyro_run)
    if by_gyro is not None:
        return by_gyro, "gyro"
    rate, source = _rate(batch, mission, last, before, motion)
    return prediction.predict_at_rate(last.known, now_ns, rate, motion.rate_walk_rad_s1_5), source


def _rate(
    batch: ObservationBatch,
    mission: Mission,
    last: RecordedAttitude,
    before: RecordedAttitude | None,
    motion: MotionSettings,
) -> tuple[prediction.Rate, RateSource]:
    passed_s = (batch.time.tai_ns - last.known.tai_ns) * 1e-9
    both = (last.body_rates_deg_per_s, batch.body_rates_deg_per_s)
    # A batch without rates has zeros.
    rates = [np.radians(each) for each in both if each.any()]
    if rates:
        settings = mission.tracking or TrackingSettings()
        sigma = math.radians(settings.body_rate_sigma_deg_per_s)
        given = prediction.given_rate(rates, sigma, passed_s)
        turning = float(np.linalg.norm(given.rad_s))
        added = 0.0
        if turning * passed_s > QUARTER_TURN_RAD:
            # A body that turns far may nutate: the difference of the rates is an error then.
            added = float(np.sum((rates[-1] - rates[0]) ** 2))
        if _contradict(before, last):
            # The rates do not lead from one attitude to the next: trust only their magnitude.
            added = turning**2
        if added:
            given = replace(given, variance=given.variance + np.eye(3) * added)
        return given, "body_rates"
    if before is not None and before.known.tai_ns < last.known.tai_ns:
        derived = prediction.derived_rate(before.known, last.known, passed_s)
        # Between the attitudes there may have been a manoeuvre, such as a flip of the roll; or the
        # body turned the other way round, if its rate may be that large.
        largest = LARGEST_SIGMAS * motion.rate_sigma_rad_s
        h = (last.known.tai_ns - before.known.tai_ns) * 1e-9
        if np.abs(derived.rad_s).max() <= largest < _other_way_rad_s(derived, h):
            return derived, "attitudes"
    return prediction.unknown_rate(motion.rate_sigma_rad_s, passed_s), "unknown"


def _other_way_rad_s(derived: prediction.Rate, step_s: float) -> float:
    """Largest component (rad/s) of the rate if the body turned the opposite way in a step."""
    angle = float(np.linalg.norm(derived.rad_s)) * step_s
    if angle == 0.0:
        # The axis is free: the largest component is least along a diagonal.
        return 2.0 * math.pi / (math.sqrt(3.0) * step_s)
    return float(np.abs(derived.rad_s).max()) * (2.0 * math.pi - angle) / angle


def _contradict(before: RecordedAttitude | None, last: RecordedAttitude) -> bool:
    """True if the rates of two batches, over more than a quarter turn, contradict the attitudes."""
    if before is None or not before.body_rates_deg_per_s.any():
        return False
    step_s = (last.known.tai_ns - before.known.tai_ns) * 1e-9
    one, other = (np.radians(each.body_rates_deg_per_s)[None] for each in (before, last))
    fastest = max(float(np.linalg.norm(one)), float(np.linalg.norm(other)))
    if fastest * step_s <= QUARTER_TURN_RAD or not other.any():
        return False
    first, second = (each.known.quaternion[None] for each in (before, last))
    steps = steps_between(first, second, np.array([step_s]), one, other)
    return not bool(steps.is_known[0])


def _by_gyro(
    connection: Connection,
    batch: ObservationBatch,
    mission: Mission,
    last: RecordedAttitude,
    before: RecordedAttitude | None,
    gyro_run: str,
) -> prediction.Known | None:
    if mission.gyro is None:
        return None
    start = shifted(last.time, -SAMPLES_BEFORE_S)
    # A filter excludes its end: extend it to include the batch's time.
    end = shifted(batch.time, 1e-6)
    selected = BlockFilter(batch.spacecraft, gyro_run, start, end)
    tai_ns, rates = gyro_in(connection, selected)
    if len(tai_ns) < 2 or not believed(mission.gyro, rates).all():
        return None
    if not rates.any() and _turns(mission, mission.gyro, batch, last, before):
        return None
    try:
        model, samples = gyro_samples(mission.gyro, tai_ns, rates)
    except BadInput:
        return None
    walk = (mission.motion or MotionSettings()).rate_walk_rad_s1_5
    return prediction.predict_by_gyro(last.known, batch.time.tai_ns, model, samples, walk)


def _turns(
    mission: Mission,
    gyro: GyroSettings,
    batch: ObservationBatch,
    last: RecordedAttitude,
    before: RecordedAttitude | None,
) -> bool:
    """True if the body certainly rotates, so that gyro samples of zero mean missing data.

    The step between the last two attitudes shows the rotation.  Rates of batches show it if the
    body has turned more than a quarter since the last attitude, or, without an attitude before
    that, if the rates exceed their errors.
    """
    both = (last.body_rates_deg_per_s, batch.body_rates_deg_per_s)
    fastest_rad_s = math.radians(float(np.linalg.norm(both, axis=1).max()))
    passed_s = (batch.time.tai_ns - last.known.tai_ns) * 1e-9
    if fastest_rad_s * passed_s > QUARTER_TURN_RAD:
        return True
    if before is None:
        tracking = mission.tracking or TrackingSettings()
        error_rad_s = math.radians(tracking.body_rate_sigma_deg_per_s) + gyro.bias_sigma_rad_s
        return fastest_rad_s > BIAS_SIGMAS * error_rad_s
    step = (before, last)
    turned = turns_beside_bias(
        gyro,
        np.array([each.known.tai_ns for each in step]),
        np.stack([each.known.quaternion for each in step]),
        np.stack([each.known.covariance_rad2 for each in step]),
        np.radians([each.body_rates_deg_per_s for each in step]),
    )
    return bool(turned[0])
