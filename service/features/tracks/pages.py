"""Panels with tracks of unmatched points, on the pages of a period and of a batch."""

from collections.abc import Iterator

from service.contract.answers import Answer, Result
from service.features.tracks.part import Tracks
from service.storage.queries.period import PeriodStars
from service.web.console.page import PageContext, Panel
from service.web.console.pages.spacecraft_page import ShownPeriod

MOST_LINKED = 600
"""Greatest number of batches in which a page searches tracks; takes about a second."""


def tracks_of_period(
    context: PageContext, name: str, run: str, shown: ShownPeriod, found: PeriodStars
) -> Iterator[Panel]:
    """Panel on the tracks in a period of a spacecraft; without tracks if it has many batches."""
    tracks = None
    if found.total <= MOST_LINKED:
        tracks = context.app.part(Tracks).of_period(name, run=run, start=shown.start, end=shown.end)
    values = {
        "name": name,
        "start": shown.start.text,
        "end": shown.end.text,
        "tracks": tracks,
        "most_linked": MOST_LINKED,
    }
    yield Panel("_tracks_of_period.html.jinja", values)


def tracks_of_batch(context: PageContext, record: Result, tried: Answer | None) -> Iterator[Panel]:
    """Panel with the tracks through the unmatched stars of a result, if there are any."""
    answer = record.answer
    if answer.attitude is None or not answer.counts.unmatched:
        return
    tracks = context.app.part(Tracks).through_batch(answer.id, answer.spacecraft, answer.run)
    if tracks.items:
        yield Panel("_tracks_of_batch.html.jinja", {"id": answer.id, "tracks": tracks})


PANELS = {"period_page": tracks_of_period, "batch_page": tracks_of_batch}
