"""Records of spacecraft: state, settings, rates, histories, gyro blocks, and the overview."""
# Written by `make client` from service/contract/spacecraft.py.

from collections.abc import Sequence
from typing import Any

from ..base import Model, Tabulated
from ..words import Status
from .answers import (
    Summary,
)


class AttitudeRow(Model, frozen=True, kw_only=True):
    """Entry of an attitude history; use the attitude only where `status` is good."""

    id: str
    batch: str
    time: str
    quaternion: Sequence[float]
    frame: str
    covariance_arcsec2: Sequence[Sequence[float]]
    residual_rms_arcsec: float | None
    """Rms of the attitude's residuals; None, as the next two, for an attitude that a tracker
    measured itself."""
    predicted_rms_arcsec: float | None
    taste: float | None
    method: str
    status: Status


class StateFault(Model, frozen=True, kw_only=True):
    """Fault of a spacecraft: what is wrong with its attitude, a tracker, alarms or freshness."""

    part: str
    state: str
    words: str
    """The fault in words, such as `critical alarm`."""
    age_s: float | None
    """Time since a batch was received (`silent`), or behind the run (`behind`)."""


class SpacecraftRow(Model, frozen=True, kw_only=True):
    """The state of a spacecraft in a run."""

    name: str
    description: str
    retired: bool
    """True if no mission file describes it any more."""
    state: str
    """Status of the latest batch's attitude, `no_attitude`, or `no_batches`; for the state of the
    spacecraft see `faults`."""
    faults: Sequence[StateFault]
    """What is wrong now, the worst first; empty: nothing."""
    latest_batch: Summary | None
    attitude: AttitudeRow | None
    """Attitude of the latest batch; None if this batch has none."""
    last_attitude: AttitudeRow | None
    """Latest attitude of the spacecraft. It can be older than the latest batch; see its time."""
    tracking: str | None
    """Tracking state of the latest batch; None if that does not ask for the last attitude."""


class MissionNow(Model, frozen=True, kw_only=True):
    """Present settings of a mission."""

    digest: str
    settings: dict[str, Any]


class MissionThen(MissionNow, frozen=True, kw_only=True):
    """Settings of a mission, with the time from which they were in use."""

    since: str


class SpacecraftState(SpacecraftRow, frozen=True, kw_only=True):
    """The state of a spacecraft, and its mission's settings with their history."""

    mission: MissionNow
    history: Sequence[MissionThen]
    """Settings of the mission, oldest first; a return to earlier settings is a new entry."""


class Rates(Model, frozen=True, kw_only=True):
    """Counts of batches and stars in an hour or a day."""

    start: str
    batches: int
    observed: int
    unique: int
    ambiguous: int
    unmatched: int
    solved: int
    """Batches with an attitude."""
    suspect: int
    """Batches with a suspect attitude."""


class Series(Model, frozen=True, kw_only=True):
    """Values of a quantity over time: bucket statistics (`minmax`) or single values (`latest`)."""

    unit: str
    count: Sequence[int] = ()
    """`minmax`: batches with a value."""
    mean: Sequence[float | None] = ()
    """Mean of each bucket (`minmax`); for shares, over all stars or batches."""
    min: Sequence[float | None] = ()
    """Least value of a batch."""
    max: Sequence[float | None] = ()
    """Greatest value of a batch."""
    value: Sequence[float | None] = ()
    """`latest`: the value of each batch."""


class History(Tabulated, frozen=True, kw_only=True):
    """History of quantities over a period, oldest first; None: unknown."""

    spacecraft: str
    run: str
    tracker: str | None = None
    """If the request names one."""
    not_split: bool = False
    """True while older batches of the run are not split by tracker yet, and are missing here; only
    with `tracker`."""
    start: str | None
    end: str | None
    strategy: str
    bucket_s: int | None
    """The width of a bucket; None for single batches."""
    source: str
    """Source of the history: batches, or sums by hour or day; both ends of the period are exact."""
    thinned: bool
    """True if the period has more batches than the answer has points."""
    unix_s: Sequence[float]
    """POSIX time of the beginning of each bucket, or of each batch. Empty buckets are omitted."""
    batches: Sequence[int] = ()
    """`minmax`: batches in each bucket."""
    time: Sequence[str] = ()
    """Time of each batch; `latest` only, like the next two fields."""
    id: Sequence[str] = ()
    batch: Sequence[str] = ()
    series: dict[str, Series]


class RankedBatch(Summary, frozen=True, kw_only=True):
    """Batch in a ranking, with its value of the ranked quantity."""

    value: float


class Ranking(Model, frozen=True, kw_only=True):
    """Ranking of the worst batches of a period by a quantity."""

    by: str
    tracker: str | None = None
    """If the request names one."""
    not_split: bool = False
    """True while older batches are not split by tracker; only with `tracker`."""
    items: Sequence[RankedBatch]


class GyroBlock(Model, frozen=True, kw_only=True):
    """Gyro block as recorded, without its samples."""

    id: str
    spacecraft: str
    run: str
    block: str
    start: str
    """Time of the first sample."""
    end: str
    """Time of the last sample."""
    samples: int
    step_s: float | None
    """Interval between samples in seconds; None: the block has a time for each sample."""
    received: str


class GyroSamples(GyroBlock, frozen=True, kw_only=True):
    """A recorded gyro block with its samples."""

    times_s: Sequence[float]
    """Times of the samples, in seconds of TAI after `start`."""
    rates_rad_per_s: Sequence[Sequence[float]]
    """Angular rates of each sample as sent, about the three axes of the mission's gyro."""
