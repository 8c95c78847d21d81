"""Tracks of observed points that no catalog star explains."""

from typing import Annotated, ClassVar, Literal

from service.storage.models.base import Count, Id, Moment, Record, doc

TrackKindName = Literal["moving", "planet", "fixed_on_sky", "fixed_on_detector", "fixed"]


class TrackPoint(Record, frozen=True, kw_only=True):
    """A point of a track."""

    component: ClassVar[str] = "TrackPoint"
    id: Annotated[Id, doc("Of the batch's result.")]
    tracker: str
    star: Annotated[Count, doc("Its place among the tracker's stars in the batch, from 0.")]
    time: Annotated[Moment, doc("Its own time, UTC.")]
    ra_deg: float
    dec_deg: float
    magnitude: float | None


class Track(Record, frozen=True, kw_only=True):
    """Points that move together, at most one of each batch and tracker."""

    component: ClassVar[str] = "TrackOut"
    kind: Annotated[
        TrackKindName,
        doc(
            "`moving`: moves on the sky, and no planet does so there. `planet`: as a planet does. "
            "`fixed_on_sky`: keeps its place among the stars. `fixed_on_detector`: keeps its place "
            "on the detector while the sky passes, as a hot pixel does. `fixed`: keeps both, "
            "because the pointing was kept."
        ),
    ]
    planet: Annotated[str | None, doc("The planet's name; null for other kinds.")]
    planet_offset_arcsec: Annotated[
        float | None,
        doc("From the ephemeris, which is good to half a minute of arc; null for other kinds."),
    ]
    first: Annotated[Moment, doc("Time of the first point, UTC.")]
    last: Annotated[Moment, doc("Time of the last point, UTC.")]
    time: Annotated[Moment, doc("The middle, for which direction and rate hold, UTC.")]
    ra_deg: Annotated[float, doc("ICRS, as a star's in the catalog: without aberration.")]
    dec_deg: float
    sigma_ra_arcsec: Annotated[float, doc("On the sky: with the cosine of the declination.")]
    sigma_dec_arcsec: float
    rate_ra_arcsec_per_s: Annotated[float, doc("On the sky: with the cosine of the declination.")]
    rate_dec_arcsec_per_s: float
    sigma_rate_ra_arcsec_per_s: float
    sigma_rate_dec_arcsec_per_s: float
    rate_arcsec_per_s: Annotated[float, doc("Along the motion.")]
    sigma_rate_arcsec_per_s: float
    magnitude: Annotated[float | None, doc("Mean of the points; null if none came with one.")]
    sigma_magnitude: Annotated[
        float | None, doc("Of the mean, from the scatter; null with fewer than two.")
    ]
    chi_square: Annotated[
        float, doc("Of the points about the motion; near `degrees_of_freedom` if the sigmas hold.")
    ]
    degrees_of_freedom: Count
    log10_expected: Annotated[
        float,
        doc("Logarithm of how many tracks as good points without any order would make."),
    ]
    points: list[TrackPoint]


class TrackList(Record, frozen=True, kw_only=True):
    """The tracks of a period, those of most points first."""

    component: ClassVar[str] = "TrackList"
    spacecraft: str
    run: str
    batches: Annotated[Count, doc("Batches of the period.")]
    without_attitude: Annotated[Count, doc("Of these, batches whose points have no direction.")]
    unexplained: Annotated[Count, doc("Unmatched stars of the others.")]
    linked: Annotated[Count, doc("Of these, points of a track.")]
    items: list[Track]
