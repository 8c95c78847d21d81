"""Service that links points without a catalog star to tracks, from the record on request."""

from collections.abc import Iterator

import numpy as np

from service import __version__
from service.app.context import Context, known_id
from service.app.factory import App
from service.errors import NotFound
from service.features.tracks import records as tracks
from service.features.tracks.finding import Track as FoundTrack
from service.features.tracks.finding import figures, find_tracks
from service.features.tracks.linking import Batches, Points
from service.features.tracks.tdm import TrackedObject, write_tdm
from service.observations.schema import LIVE
from service.storage.queries.pages import ResultFilter
from service.times import Utc, shifted, utc_now
from service.vectors import to_ra_dec

MOST_BATCHES = 2_000
"""Greatest number of batches in a requested period; they are read in a few seconds."""
EACH_SIDE = 20
"""Number of batches before and after a batch in which its tracks are searched."""


class Tracks:
    """Links points without a catalog star to tracks, without recording them."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def close(self) -> None:
        """Do nothing on closing: no file and no connection is open."""

    def of_period(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        most_batches: int = MOST_BATCHES,
    ) -> tracks.TrackList:
        """Tracks in a spacecraft's batches of a period; see `find_tracks`.

        Raises `BadBatch` if the period has more than `most_batches`, or too many points.
        """
        self._context.mission(name)
        selected = ResultFilter(run or LIVE, name, start, end)
        with self._context.reading() as connection:
            recorded = tracks.batches_of_period(connection, selected, most_batches)
        return _tracks(name, run or LIVE, recorded)

    def through_batch(self, id: str, spacecraft: str, run: str) -> tracks.TrackList:
        """Tracks through one result, from its batch and `EACH_SIDE` batches on either side."""
        with self._context.reading() as connection:
            recorded = tracks.batches_around(connection, known_id(id, "batch"), EACH_SIDE)
        found = _tracks(spacecraft, run, recorded)
        own = [each for each in found.items if any(point.id == id for point in each.points)]
        return tracks.TrackList(
            spacecraft=spacecraft,
            run=run,
            batches=found.batches,
            without_attitude=found.without_attitude,
            unexplained=found.unexplained,
            linked=found.linked,
            items=own,
        )

    def tdm(self, found: tracks.TrackList) -> Iterator[bytes]:
        """Moving tracks as a CCSDS TDM (Tracking Data Message); raises `NotFound` without any."""
        mission = self._context.mission(found.spacecraft)
        moving = [each for each in found.items if each.kind == "moving"]
        if not moving:
            raise NotFound(f"{found.spacecraft}: no moving track, and a TDM cannot be empty")
        objects = [_tracked(each) for each in moving]
        observer = mission.products.object_id or found.spacecraft
        return write_tdm(
            observer, found.run, utc_now().text, __version__, sorted(objects, key=_begin)
        )


def _begin(each: TrackedObject) -> str:
    return each.time[0]


def _tracked(track: tracks.Track) -> TrackedObject:
    rate, sigma = track.rate_arcsec_per_s, track.sigma_rate_arcsec_per_s
    return TrackedObject(
        name=f"TRACK-{track.time[:19]}-{track.ra_deg:.2f}{track.dec_deg:+.2f}",
        comments=(
            f"Rate {rate:.6g} arcsec/s with sigma {sigma:.2g}, at {track.time}",
            f"Sigma of the right ascension then {track.sigma_ra_arcsec:.3g} arcsec on the sky",
            f"Sigma of the declination then {track.sigma_dec_arcsec:.3g} arcsec",
        ),
        time=tuple(each.time for each in track.points),
        ra_deg=tuple(each.ra_deg for each in track.points),
        dec_deg=tuple(each.dec_deg for each in track.points),
        magnitude=tuple(each.magnitude for each in track.points),
    )


def _tracks(name: str, run: str, recorded: tracks.RecordedBatches) -> tracks.TrackList:
    gathered = tracks.unexplained_points(recorded)
    points, batches = gathered.points, gathered.batches
    found = find_tracks(points, batches)
    return tracks.TrackList(
        spacecraft=name,
        run=run,
        batches=len(recorded.rows),
        without_attitude=len(recorded.rows) - len(batches.time),
        unexplained=len(points),
        linked=sum(len(each.own) for each in found),
        items=[_record(each, points, batches) for each in found],
    )


def _record(track: FoundTrack, points: Points, batches: Batches) -> tracks.Track:
    own, numbers = track.own, figures(track, points)
    first = batches.time[0]
    moments = [shifted(first, each).text for each in points.time_s[own].tolist()]
    ra_deg, dec_deg = to_ra_dec(points.direction[own])
    magnitude = points.magnitude_mag[own]
    return tracks.Track(
        kind=track.kind,
        planet=track.planet,
        planet_offset_arcsec=track.planet_offset_arcsec,
        first=min(moments),
        last=max(moments),
        time=shifted(first, numbers.time_s).text,
        ra_deg=numbers.ra_deg,
        dec_deg=numbers.dec_deg,
        sigma_ra_arcsec=numbers.sigma_ra_arcsec,
        sigma_dec_arcsec=numbers.sigma_dec_arcsec,
        rate_ra_arcsec_per_s=numbers.rate_ra_arcsec_per_s,
        rate_dec_arcsec_per_s=numbers.rate_dec_arcsec_per_s,
        sigma_rate_ra_arcsec_per_s=numbers.sigma_rate_ra_arcsec_per_s,
        sigma_rate_dec_arcsec_per_s=numbers.sigma_rate_dec_arcsec_per_s,
        rate_arcsec_per_s=numbers.rate_arcsec_per_s,
        sigma_rate_arcsec_per_s=numbers.sigma_rate_arcsec_per_s,
        magnitude=numbers.magnitude_mag,
        sigma_magnitude=numbers.sigma_magnitude_mag,
        chi_square=numbers.chi_square,
        degrees_of_freedom=numbers.degrees_of_freedom,
        log10_expected=track.log10_expected,
        points=[
            tracks.TrackPoint(
                id=batches.id[points.batch[k]],
                tracker=points.trackers[points.tracker[k]],
                star=int(points.number[k]),
                time=moments[n],
                ra_deg=float(ra_deg[n]),
                dec_deg=float(dec_deg[n]),
                magnitude=float(magnitude[n]) if np.isfinite(magnitude[n]) else None,
            )
            for n, k in enumerate(own.tolist())
        ],
    )


def open_part(app: App) -> Tracks:
    """Create the service for tracks of an open app."""
    return Tracks(app.context)
