"""Tracks of observed points that no catalog star explains."""

from ..base import Model


class TrackPoint(Model, frozen=True):
    """A point of a track: the result, the tracker, and its place among the tracker's stars."""

    id: str
    tracker: str
    star: int
    time: str
    ra_deg: float
    dec_deg: float
    magnitude: float | None


class Track(Model, frozen=True, kw_only=True):
    """Points that move together; direction and rate hold for `time`, the middle.

    `kind` is moving, planet, fixed_on_sky, fixed_on_detector or fixed.  Components along right
    ascension are on the sky: with the cosine of the declination.
    """

    kind: str
    planet: str | None
    planet_offset_arcsec: float | None
    first: str
    last: str
    time: str
    ra_deg: float
    dec_deg: float
    sigma_ra_arcsec: float
    sigma_dec_arcsec: float
    rate_ra_arcsec_per_s: float
    rate_dec_arcsec_per_s: float
    sigma_rate_ra_arcsec_per_s: float
    sigma_rate_dec_arcsec_per_s: float
    rate_arcsec_per_s: float
    sigma_rate_arcsec_per_s: float
    magnitude: float | None
    sigma_magnitude: float | None
    chi_square: float
    degrees_of_freedom: int
    log10_expected: float
    points: list[TrackPoint]


class TrackList(Model, frozen=True, kw_only=True):
    """The tracks of a period, those of most points first.

    `unexplained` counts the unmatched stars of batches with an attitude, `linked` those of them
    that are points of a track.
    """

    spacecraft: str
    run: str
    batches: int
    without_attitude: int
    unexplained: int
    linked: int
    items: list[Track]
