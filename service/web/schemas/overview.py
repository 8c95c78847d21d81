"""All spacecraft at a glance."""

from pydantic import Field

from service.web.schemas.alarms import AlarmOut, AlarmSummary
from service.web.schemas.base import Components, Count, Digest, Moment, Shape
from service.web.schemas.spacecraft import SpacecraftRow

Shares = list[float]


class WindowOut(Shape):
    """What was observed in a stretch of time that ends with the run's latest batch."""

    start: Moment
    end: Moment
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    solved: Count = Field(description="Batches with an attitude.")
    suspect: Count


class Sparkline(Shape):
    """The shares of stars, step by step; steps without a batch are left out."""

    bucket_s: int
    unix_s: list[float] = Field(description="POSIX time at which each step begins.")
    batches: list[Count]
    unique_share: Shares
    ambiguous_share: Shares
    unmatched_share: Shares


class OverviewRow(SpacecraftRow):
    """One spacecraft at a glance; without a batch in the run all of it is null."""

    sigma_arcsec: Components | None = Field(
        description="Of `last_attitude`, about the body axes; see its time."
    )
    age_s: float | None = Field(description="From its latest batch to the run's latest.")
    received_age_s: float | None = Field(description="Since its latest batch was received.")
    last_hour: WindowOut | None
    last_day: WindowOut | None
    sparkline_hour: Sparkline | None
    sparkline_day: Sparkline | None
    alarms: list[AlarmOut] = Field(description="Those that are not cleared, the worst first.")


class Overview(Shape):
    """Every spacecraft in a run."""

    run: str
    default_run: str = Field(description="`live`, or while that is empty the newest run.")
    as_of: Moment | None = Field(description="The time of the run's latest batch.")
    now: Moment = Field(description="The service's clock.")
    alarms: AlarmSummary
    items: list[OverviewRow]


class CatalogAbout(Shape):
    """The star catalog."""

    digest: Digest
    name: str
    stars: Count


class MissionAbout(Shape):
    """A mission that is served."""

    name: str
    description: str
    digest: Digest


class About(Shape):
    """What answers here."""

    version: str
    started: Moment
    database: str = Field(examples=["sqlite", "postgresql"])
    catalog: CatalogAbout
    missions: list[MissionAbout]
    credits: list[str]
