"""Two sets of options side by side."""

from pydantic import Field

from service.web.schemas.answers import CountsOut
from service.web.schemas.base import Count, Id, Moment, Outcome, Settings, Shape


class SideOut(CountsOut):
    """What one set of options makes of all batches."""

    options: Settings
    solved: Count
    suspect: Count
    residual_ratio_mean: float | None
    us_per_batch: float | None = Field(description="The median; zones, stars and attitude.")


class Transition(Shape):
    """How many stars go from an outcome on side a to one on side b; equal ones are there too."""

    from_: Outcome = Field(alias="from")
    to: Outcome
    stars: Count


class AttitudesOut(Shape):
    """Which side has an attitude, and how far apart they are where both have."""

    both: Count
    only_a: Count
    only_b: Count
    neither: Count
    angle_arcsec_median: float | None
    angle_arcsec_max: float | None


class StarSide(Shape):
    """One star on one side."""

    outcome: Outcome
    star: str | None


class StarChange(Shape):
    """One star that differs."""

    tracker: str
    position: Count = Field(description="Among the tracker's stars, from 0.")
    a: StarSide
    b: StarSide


class BatchChange(Shape):
    """One batch of which a star or the attitude differs."""

    id: Id
    batch: str
    time: Moment
    a: CountsOut
    b: CountsOut
    attitude_angle_arcsec: float | None
    stars: list[StarChange]


class Comparison(Shape):
    """Both sides, and where they differ."""

    spacecraft: str
    run: str
    start: Moment | None = Field(description="The time of the earliest batch that was taken.")
    end: Moment | None
    batches_in_stretch: Count
    sampled: Count
    compared: Count
    cut_short: bool = Field(description="Whether time ran out before all were compared.")
    a: SideOut
    b: SideOut
    transitions: list[Transition]
    renamed: Count = Field(description="Stars that are unique on both sides under other names.")
    attitudes: AttitudesOut
    changed_batches: Count
    changed: list[BatchChange] = Field(description="The first hundred, oldest first.")
