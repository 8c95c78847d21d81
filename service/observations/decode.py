"""Decoding of a batch's canonical JSON, which passed all checks, to arrays.

The arrays are made from the recorded text, so that a later run of the record gives the same result.
One process may check a batch and another compute it: they exchange only the text.
"""

import math
from typing import Any, Final

import msgspec
import numpy as np

from service.missions.mission import Identifier, SolverName
from service.observations.batch import (
    Aberration,
    APriori,
    BoresightPrior,
    MeasuredAttitude,
    ObservationBatch,
    Options,
    PredictedPrior,
    QuaternionPrior,
    Readings,
    SunPointedPrior,
    TrackerStars,
    Tracking,
)
from service.times import parse_utc
from service.vectors import Vector, read_only, unit_of

Triple = tuple[float, float, float]

_ABSENT: Final = math.nan
_NO_VECTOR: Final = (_ABSENT, _ABSENT, _ABSENT)


class _SentPart(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """Base class of the JSON objects in a canonical batch, with the defaults of `schema`."""


class SentStar(_SentPart):
    """One observed star in a canonical batch; absent numbers are NaN."""

    vector: Triple = _NO_VECTOR
    h_deg: float = _ABSENT
    v_deg: float = _ABSENT
    magnitude: float = _ABSENT
    time_offset_s: float = 0.0
    sigma_arcsec: float = _ABSENT
    h_counts: list[float] | None = None
    v_counts: list[float] | None = None
    h_times: list[float] | None = None
    v_times: list[float] | None = None


class SentTracker(_SentPart):
    """The stars observed by one tracker, or the line sums of its raster, in a canonical batch."""

    tracker: str
    stars: list[SentStar]
    column_counts: list[float] | None = None
    row_counts: list[float] | None = None


class SentDirection(_SentPart):
    """A direction as right ascension and declination, in a canonical batch."""

    ra_deg: float
    dec_deg: float


class SentPrediction(_SentPart):
    """The prediction of an attitude that a batch was recorded with, or the reason for none."""

    quaternion: tuple[float, float, float, float] | None = None
    covariance_arcsec2: tuple[Triple, Triple, Triple] | None = None
    margin_deg: float = _ABSENT
    result: str | None = None
    age_s: float | None = None
    rate: str | None = None
    reason: str | None = None


class SentMeasurement(_SentPart):
    """An attitude measured by a tracker itself, in a canonical batch."""

    quaternion: tuple[float, float, float, float]
    tracker: str | None = None
    sigma_arcsec: Triple | None = None
    covariance_arcsec2: tuple[Triple, Triple, Triple] | None = None
    frame: str = "EME2000"


class SentPrior(_SentPart):
    """A priori knowledge of one kind, in a canonical batch; fields of other kinds are absent."""

    quaternion: tuple[float, float, float, float] | None = None
    boresight: SentDirection | None = None
    sun_pointed: bool = False
    sun_counts: tuple[float, float, float, float] | None = None
    sun_vector: Triple | None = None
    position_km: Triple | None = None
    frame: str = "EME2000"
    from_: str | None = msgspec.field(default=None, name="from")
    by_default: bool = False
    prediction: SentPrediction | None = None


class SentOptions(_SentPart):
    """Options of a canonical batch that override the mission's settings."""

    identifier: Identifier | None = None
    solver: SolverName | None = None
    tests: dict[str, bool] = {}
    tolerances: dict[str, float] = {}
    zone_grid_deg: float | None = None


class SentBatch(_SentPart):
    """A canonical batch of observed stars, or of an attitude measured by a tracker itself."""

    spacecraft: str
    batch: str
    time: str
    a_priori: SentPrior | None
    observations: list[SentTracker] = []
    measurement: SentMeasurement | None = None
    run: str = "live"
    body_rates_deg_per_s: Triple = (0.0, 0.0, 0.0)
    velocity_km_per_s: Triple | None = None
    sun_vector: Triple | None = None
    position_km: Triple | None = None
    aberration: Aberration = "to_correct"
    options: SentOptions = msgspec.field(default_factory=SentOptions)
    remarks: tuple[str, ...] = ()


_BATCH = msgspec.json.Decoder(SentBatch)
_PRIOR = msgspec.json.Decoder(SentPrior)


def batch_from_canonical(text: str) -> ObservationBatch:
    """An observation batch decoded from its canonical JSON."""
    sent = _BATCH.decode(text)
    chosen, prior = sent.options, sent.a_priori
    return ObservationBatch(
        spacecraft=sent.spacecraft,
        batch=sent.batch,
        run=sent.run,
        time=parse_utc(sent.time),
        a_priori=None if prior is None else _prior_of(prior, sent.sun_vector, sent.position_km),
        body_rates_deg_per_s=_array(sent.body_rates_deg_per_s),
        velocity_km_per_s=_optional_array(sent.velocity_km_per_s),
        aberration=sent.aberration,
        observations=tuple([_tracker_stars(each) for each in sent.observations]),
        options=Options(
            identifier=chosen.identifier,
            solver=chosen.solver,
            tests=chosen.tests,
            tolerances=chosen.tolerances,
            zone_grid_deg=chosen.zone_grid_deg,
        ),
        position_km=_optional_array(sent.position_km),
        tracking=None if prior is None or prior.from_ is None else _tracking_of(prior),
        measurement=None if sent.measurement is None else _measured(sent.measurement),
        remarks=sent.remarks,
    )


def prior_from_canonical(text: str) -> APriori | None:
    """A priori knowledge without a batch, decoded from canonical JSON; None for the last one."""
    return _prior_of(_PRIOR.decode(text), None, None)


def _prior_of(
    prior: SentPrior, sun_vector: Triple | None, position_km: Triple | None
) -> APriori | None:
    """A priori knowledge as the solver takes it; the batch's own Sun vector may complete it.

    None where no attitude could be predicted from the last one.
    """
    if prior.from_ is not None:
        prediction = prior.prediction
        if prediction is None or prediction.quaternion is None:
            return None
        return PredictedPrior(
            _quaternion(prediction.quaternion),
            _array(prediction.covariance_arcsec2),
            prediction.margin_deg,
        )
    if prior.quaternion is not None:
        return QuaternionPrior(_quaternion(prior.quaternion))
    if prior.boresight is not None:
        return BoresightPrior(prior.boresight.ra_deg, prior.boresight.dec_deg)
    sun = prior.sun_vector or sun_vector
    return SunPointedPrior(
        None if sun is None else read_only(unit_of(np.array(sun))),
        _optional_array(prior.position_km or position_km),
        None if prior.sun_counts is None else _array(prior.sun_counts),
    )


def _measured(sent: SentMeasurement) -> MeasuredAttitude:
    covariance: Any = sent.covariance_arcsec2
    if sent.sigma_arcsec is not None:
        covariance = np.diag(np.square(sent.sigma_arcsec))
    return MeasuredAttitude(_quaternion(sent.quaternion), _array(covariance), sent.tracker)


def _quaternion(components: tuple[float, float, float, float]) -> Vector:
    # Plain numbers are faster: numpy takes as long for four as for a thousand.
    q1, q2, q3, qc = components
    norm = math.sqrt(q1 * q1 + q2 * q2 + q3 * q3 + qc * qc)
    return _array((q1 / norm, q2 / norm, q3 / norm, qc / norm))


def _tracking_of(prior: SentPrior) -> Tracking:
    prediction = prior.prediction
    if prediction is None:
        return Tracking(prior.by_default)
    return Tracking(
        prior.by_default,
        prediction.result,
        prediction.age_s,
        prediction.rate,
        prediction.reason,
        resolved=True,
    )


def _tracker_stars(tracker: SentTracker) -> TrackerStars:
    stars = tracker.stars
    vectors: list[float] = []
    for star in stars:
        x, y, z = star.vector
        # The norm is near one, or NaN: no division by zero.
        norm = math.sqrt(x * x + y * y + z * z)
        vectors += (x / norm, y / norm, z / norm)
    # The arrays are views of one block: allocating an array takes longer than filling it.
    numbers = [
        *vectors,
        *[star.h_deg for star in stars],
        *[star.v_deg for star in stars],
        *[star.magnitude for star in stars],
        *[star.time_offset_s for star in stars],
        *[star.sigma_arcsec for star in stars],
    ]
    n = len(stars)
    block = read_only(np.fromiter(numbers, np.float64, len(numbers)))
    return TrackerStars(
        tracker=tracker.tracker,
        vector=block[: 3 * n].reshape(n, 3),
        angles_deg=block[3 * n : 5 * n].reshape(2, n).T,
        magnitude_mag=block[5 * n : 6 * n],
        time_offset_s=block[6 * n : 7 * n],
        sigma_arcsec=block[7 * n :],
        readings=_readings(tracker),
    )


def _readings(tracker: SentTracker) -> tuple[Readings | None, ...]:
    if tracker.column_counts is not None:
        return (Readings("lines", _array(tracker.column_counts), _array(tracker.row_counts)),)
    found = tuple([_reading(star) for star in tracker.stars])
    return found if any(found) else ()


def _reading(star: SentStar) -> Readings | None:
    if star.h_counts is not None:
        return Readings("counts", _array(star.h_counts), _array(star.v_counts))
    if star.h_times is not None:
        return Readings("times", _array(star.h_times), _array(star.v_times))
    return None


def _array(values: Any) -> Vector:
    return read_only(np.array(values, np.float64))


def _optional_array(values: Triple | None) -> Vector | None:
    return None if values is None else _array(values)


class _Rates(msgspec.Struct):
    body_rates_deg_per_s: tuple[float, float, float] | None = None


RECORDED_RATES = msgspec.json.Decoder(_Rates)
"""A JSON decoder of a recorded batch's body rates alone, None where there are none."""
