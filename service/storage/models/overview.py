"""All spacecraft at a glance."""

from typing import Annotated, ClassVar

from pydantic import Field

from service.storage.models.alarms import Alarm, AlarmSummary
from service.storage.models.base import Components, Count, Digest, Moment, Record, Stamp, doc
from service.storage.models.spacecraft import SpacecraftRow

Shares = list[float]


class WindowCounts(Record, frozen=True, kw_only=True):
    """Counts in a period that ends with the run's latest batch."""

    component: ClassVar[str] = "WindowOut"
    start: Moment
    end: Moment
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    solved: Annotated[Count, doc("Batches with an attitude.")]
    suspect: Count


class Sparkline(Record, frozen=True, kw_only=True):
    """Shares of stars in time steps; steps without batches are omitted."""

    component: ClassVar[str] = "Sparkline"
    bucket_s: int
    unix_s: Annotated[list[float], doc("POSIX time of the beginning of each step.")]
    batches: list[Count]
    unique_share: Shares
    ambiguous_share: Shares
    unmatched_share: Shares


class OverviewRow(SpacecraftRow, frozen=True, kw_only=True):
    """The state of one spacecraft; null without a batch in the run."""

    component: ClassVar[str] = "OverviewRow"
    sigma_arcsec: Annotated[
        Components | None,
        doc("Standard deviations of `last_attitude` about the body axes."),
    ]
    age_s: Annotated[float | None, doc("Time from its latest batch to the run's latest batch.")]
    received_age_s: Annotated[
        float | None, doc("Time since the service received its latest batch.")
    ]
    last_hour: WindowCounts | None
    last_day: WindowCounts | None
    sparkline_hour: Sparkline | None
    sparkline_day: Sparkline | None
    alarms: Annotated[list[Alarm], doc("Alarms that are not cleared, worst first.")]


class Overview(Record, frozen=True, kw_only=True):
    """Every spacecraft in a run."""

    component: ClassVar[str] = "Overview"
    run: str
    default_run: Annotated[str, doc("`live`; while it is empty, the newest run.")]
    as_of: Annotated[Moment | None, doc("The time of the run's latest batch.")]
    now: Annotated[Stamp, doc("The service's clock.")]
    alarms: AlarmSummary
    items: list[OverviewRow]


class CatalogAbout(Record, frozen=True, kw_only=True):
    """The star catalog."""

    component: ClassVar[str] = "CatalogAbout"
    digest: Digest
    name: str
    stars: Count


class MissionAbout(Record, frozen=True, kw_only=True):
    """A mission of this service."""

    component: ClassVar[str] = "MissionAbout"
    name: str
    description: str
    digest: Digest


class About(Record, frozen=True, kw_only=True):
    """The service and its data."""

    component: ClassVar[str] = "About"
    version: str
    started: Stamp
    database: Annotated[str, Field(examples=["sqlite", "postgresql"])]
    catalog: CatalogAbout
    missions: list[MissionAbout]
    credits: list[str]
