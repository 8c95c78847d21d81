"""Two sets of options side by side, and two runs."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from msgspec import Struct, field

from service.storage.models.answers import StarCounts
from service.storage.models.base import Count, Id, MissionSettings, Moment, Outcome, Record, doc
from service.times import Utc
from service.vectors import Vector


class ComparedSide(StarCounts, frozen=True, kw_only=True):
    """Results of all batches with one set of options."""

    component: ClassVar[str] = "SideOut"
    options: MissionSettings
    solved: Count
    suspect: Count
    residual_ratio_mean: float | None
    us_per_batch: float | None
    """Median time for zones, identification and attitude."""


class Transition(Record, frozen=True, kw_only=True):
    """Number of stars with an outcome on side a and an outcome on side b, including equal ones."""

    from_: Outcome = field(name="from")
    to: Outcome
    stars: Count


class ComparedAttitudes(Record, frozen=True, kw_only=True):
    """How many batches have an attitude on either side, and the angles between them."""

    component: ClassVar[str] = "AttitudesOut"
    both: Count
    only_a: Count
    only_b: Count
    neither: Count
    angle_arcsec_median: float | None
    angle_arcsec_max: float | None


class StarSide(Record, frozen=True, kw_only=True):
    """One star on one side."""

    outcome: Outcome
    star: str | None


class StarChange(Record, frozen=True, kw_only=True):
    """One star that differs."""

    tracker: str
    position: Annotated[Count, doc("Position among the tracker's stars, from 0.")]
    a: StarSide
    b: StarSide


class BatchChange(Record, frozen=True, kw_only=True):
    """One batch of which a star or the attitude differs."""

    id: Id
    batch: str
    time: Moment
    a: StarCounts
    b: StarCounts
    attitude_angle_arcsec: float | None
    stars: list[StarChange]


class ComparedCell(Record, frozen=True, kw_only=True):
    """Stars of the batches of one cell of time, by outcome on both sides."""

    start: Moment
    a: StarCounts
    b: StarCounts


class Comparison(Record, frozen=True, kw_only=True):
    """The results of both sides, and their differences."""

    spacecraft: str
    run: str
    start: Annotated[Moment | None, doc("Time of the earliest batch of the sample.")]
    end: Moment | None
    batches_in_stretch: Count
    sampled: Count
    compared: Count
    cut_short: Annotated[bool, doc("Whether the time limit ended the comparison early.")]
    cell_s: Annotated[Count, doc("Width of the cells of the trend, in seconds.")]
    trend: Annotated[list[ComparedCell], doc("The cells of time that have batches, oldest first.")]
    a: ComparedSide
    b: ComparedSide
    transitions: list[Transition]
    renamed: Count
    """Stars that are unique on both sides, but as different catalog stars."""
    attitudes: ComparedAttitudes
    changed_batches: Count
    changed: Annotated[list[BatchChange], doc("The first hundred, oldest first.")]


class OutcomeCounts(Struct, frozen=True, kw_only=True):
    """Stars by outcome, without their sum."""

    unique: int
    ambiguous: int
    unmatched: int


class StatusCounts(Struct, frozen=True, kw_only=True):
    """Batches by the status of their attitude."""

    good: int = 0
    suspect: int = 0
    none: int = 0


class RunTransition(Struct, frozen=True, kw_only=True):
    """Number of stars with an outcome in one run and an outcome in the other."""

    before: str
    after: str
    same_star: bool
    stars: int

    @property
    def is_change(self) -> bool:
        """True if the outcome differs, or the named star."""
        return self.before != self.after or (self.before == "unique" and not self.same_star)


class RunStars(Struct, frozen=True, kw_only=True):
    """Outcomes of the stars of the batches that both runs have."""

    observed: int
    before: OutcomeCounts
    after: OutcomeCounts
    transitions: list[RunTransition]


class AngleStatistics(Struct, frozen=True, kw_only=True):
    """Angles between the attitudes of two runs, in arcseconds."""

    median: float
    p95: float
    max: float


class RunAttitudes(Struct, frozen=True, kw_only=True):
    """Attitudes of the batches that both runs have, and the angles between them."""

    before: StatusCounts
    after: StatusCounts
    in_both: int
    angle_arcsec: AngleStatistics | None


class RunComparison(Struct, frozen=True, kw_only=True):
    """The batches that two runs have in common: `before` in `run`, `after` in `other`."""

    run: str | None
    other: str
    batches: int
    stars: RunStars
    attitudes: RunAttitudes


class RunChangeSide(Struct, frozen=True, kw_only=True):
    """What a batch came to in one of two runs."""

    id: Id
    counts: OutcomeCounts
    status: str | None


class RunChange(Struct, frozen=True, kw_only=True):
    """A batch that came to something else in another run."""

    batch: str
    time: Moment
    before: RunChangeSide
    after: RunChangeSide


@dataclass(frozen=True)
class RunRates:
    """All current results of a spacecraft in one run."""

    run: str
    totals: Mapping[str, int]
    """The totals of a rollup's counts, such as `observed`."""
    shares: Mapping[str, Vector]
    """Shares of the observed stars: `ambiguous`, `unmatched` in each cell; NaN without a star."""


@dataclass(frozen=True)
class RatesOfRuns:
    """Runs over one period, divided into cells of an hour, a day or several days."""

    start: Utc
    end: Utc
    cell_s: int
    runs: tuple[RunRates, ...]
