"""Tracks as text for a terminal."""

from service.features.tracks.records import Track, TrackList

_HEADING = (
    f"{'track':<24}{'middle':<26}{'points':>6}  {'RA, Dec':<24}"
    f"{'rate, arcsec/s':>20}  {'magnitude':>13}"
)


def tracks_text(found: TrackList) -> str:
    """Format tracks as a table of text."""
    counts = (
        f"{found.batches:,} batches, {found.without_attitude:,} without attitude; "
        f"{found.unexplained:,} unmatched stars, {found.linked:,} of them on tracks"
    )
    return "\n".join([counts, _HEADING, *map(_line, found.items)] if found.items else [counts])


def _line(track: Track) -> str:
    name = track.planet or track.kind.replace("_", " ")
    rate = f"{track.rate_arcsec_per_s:.4f} ± {track.sigma_rate_arcsec_per_s:.4f}"
    magnitude = "–" if track.magnitude is None else f"{track.magnitude:.2f}"
    if track.sigma_magnitude is not None:
        magnitude += f" ± {track.sigma_magnitude:.2f}"
    place = f"{track.ra_deg:.5f}° {track.dec_deg:+.5f}°"
    return (
        f"{name:<24}{track.time:<26}{len(track.points):>6}  {place:<24}{rate:>20}  {magnitude:>13}"
    )
