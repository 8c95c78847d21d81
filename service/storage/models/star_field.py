"""The stars of a batch in each tracker's field of view: the data of the chart on its page.

Directions are given as `h_deg`, `v_deg`: that of (tan h, tan v, 1) in the tracker's axes.
"""

from service.storage.models.base import Record


class Boresight(Record, frozen=True, kw_only=True):
    """The boresight in the inertial frame."""

    ra_deg: float
    dec_deg: float


class CatalogStarPlace(Record, frozen=True, kw_only=True):
    """A catalog star in the field of view."""

    id: str
    magnitude: float
    h_deg: float
    v_deg: float


class ObservedStarPlace(Record, frozen=True, kw_only=True):
    """An observed star with its outcome; `residual_arcsec` is observed minus predicted.

    The residual is along h and along v, None if the attitude does not use the star.
    """

    outcome: str
    star: str | None
    rivals: list[str]
    magnitude: float | None
    h_deg: float
    v_deg: float
    residual_arcsec: tuple[float, float] | None


class TrackerField(Record, frozen=True, kw_only=True):
    """The view of one tracker; `zone_edges` are lines of [h, v] in degrees."""

    tracker: str
    boresight: Boresight
    field_of_view_radius_deg: float
    radius_deg: float
    magnitude_limit_mag: float
    zone_edges: list[list[list[float]]]
    catalog: list[CatalogStarPlace]
    observed: list[ObservedStarPlace]


class StarField(Record, frozen=True, kw_only=True):
    """The views of all trackers of a batch.

    `through` is "quest", "triad" or "a_priori": the attitude by which catalog stars are drawn.
    `same_catalog` says whether the run catalog is the one of the answer.
    """

    through: str
    same_catalog: bool
    trackers: list[TrackerField]
