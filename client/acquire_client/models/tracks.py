"""Records of tracks for the API, and the recorded batches that they are computed from."""
# Written by `make client` from service/features/tracks/records.py.

from collections.abc import Sequence

from ..base import Model


class TrackPoint(Model, frozen=True, kw_only=True):
    """A point of a track: an unmatched star of one batch and tracker."""

    id: str
    """The result of the batch."""
    tracker: str
    star: int
    """Its place among the tracker's stars in the batch, from 0."""
    time: str
    """Its own time, UTC."""
    ra_deg: float
    dec_deg: float
    magnitude: float | None


class Track(Model, frozen=True, kw_only=True):
    """A track: points that move together, at most one per batch and tracker."""

    kind: str
    """`moving`: moves on the sky, and no planet does so there. `planet`: as a planet does.
    `fixed_on_sky`: keeps its place among the stars. `fixed_on_detector`: keeps its place on the
    detector while the sky passes, as a hot pixel does. `fixed`: keeps both, because the pointing
    was kept."""
    planet: str | None
    """The planet's name; None for other kinds."""
    planet_offset_arcsec: float | None
    """From the ephemeris, which is good to half a minute of arc; None for other kinds."""
    first: str
    """Time of the first point, UTC."""
    last: str
    """Time of the last point, UTC."""
    time: str
    """The middle, for which direction and rate hold, UTC."""
    ra_deg: float
    """ICRS, as a star's in the catalog: without aberration."""
    dec_deg: float
    sigma_ra_arcsec: float
    """On the sky: with the cosine of the declination."""
    sigma_dec_arcsec: float
    rate_ra_arcsec_per_s: float
    """On the sky: with the cosine of the declination."""
    rate_dec_arcsec_per_s: float
    sigma_rate_ra_arcsec_per_s: float
    sigma_rate_dec_arcsec_per_s: float
    rate_arcsec_per_s: float
    """Along the motion."""
    sigma_rate_arcsec_per_s: float
    magnitude: float | None
    """Mean of the points; None if none came with one."""
    sigma_magnitude: float | None
    """Sigma of the mean, from the scatter; None with fewer than two."""
    chi_square: float
    """Scatter about the motion; near `degrees_of_freedom` if the sigmas hold."""
    degrees_of_freedom: int
    log10_expected: float
    """Logarithm of how many tracks as good points without any order would make."""
    points: Sequence[TrackPoint]


class TrackList(Model, frozen=True, kw_only=True):
    """The tracks in a period, the track with the most points first."""

    spacecraft: str
    run: str
    batches: int
    """Batches of the period."""
    without_attitude: int
    """Batches of these whose points have no direction."""
    unexplained: int
    """Unmatched stars of the others."""
    linked: int
    """Unmatched stars that are points of a track."""
    items: Sequence[Track]
