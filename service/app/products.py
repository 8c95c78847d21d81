"""Products: the attitudes of a spacecraft as a series, for any format."""

from typing import Literal

from service import __version__
from service.app.context import Context
from service.errors import BadBatch, Fault
from service.missions.mission import mission_named
from service.products.attitudes import (
    AttitudeSeries,
    SeriesInfo,
    SeriesTracker,
    StatusWanted,
    series_of,
)
from service.products.moment import AtMethod, AttitudeAt, attitude_at
from service.products.tables import Table
from service.storage.queries.attitude_rows import attitude_pages, count_results
from service.storage.queries.future_dated import LIVE
from service.storage.queries.pages import ResultFilter
from service.storage.queries.tables.result_tables import batch_table, star_table
from service.times import Utc, shifted, utc_now

Order = Literal["oldest", "newest"]
AROUND = 200
"""Batches on either side of a moment among which its attitude is looked for."""
TableKind = Literal["batches", "stars"]
_TABLES = {"batches": batch_table, "stars": star_table}


class Products:
    """Reads what leaves the service as files."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def attitudes(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        status: StatusWanted = "good",
        order: Order = "oldest",
        largest_gap_s: float | None = None,
        object_id: str | None = None,
        naif_id: int | None = None,
        most_batches: int | None = None,
    ) -> AttitudeSeries:
        """The attitudes of a spacecraft's current results in a run; see `series_of`.

        They are read as the series is.  The largest gap and the identifiers are the mission's
        where they are None.  Raises `BadBatch` where a period has more than `most_batches`.
        """
        mission = mission_named(self._context.missions, name)
        own = mission.products
        about = SeriesInfo(
            spacecraft=name,
            run=run or LIVE,
            created=utc_now().text,
            version=__version__,
            start=None if start is None else start.text,
            end=None if end is None else end.text,
            status=status,
            newest_first=order == "newest",
            largest_gap_s=own.largest_gap_s if largest_gap_s is None else largest_gap_s,
            object_id=own.object_id if object_id is None else object_id,
            naif_id=own.naif_id if naif_id is None else naif_id,
            # The mission's clock is that of its own id.
            sclk_kernel=own.sclk_kernel if naif_id in (None, own.naif_id) else None,
            trackers=tuple(
                SeriesTracker(
                    each.name, tuple(map(tuple, each.body_from_tracker.tolist())), each.sigma_arcsec
                )
                for each in mission.trackers
            ),
        )
        selected = ResultFilter(about.run, name, start, end)
        if most_batches is not None:
            with self._context.reading() as connection:
                _require_at_most(
                    most_batches, count_results(connection, selected, most_batches + 1)
                )
        pages = attitude_pages(self._context.reading, selected, newest_first=about.newest_first)
        return series_of(about, pages)

    def attitude_at(
        self,
        name: str,
        moment: Utc,
        method: AtMethod,
        *,
        run: str | None = None,
        status: StatusWanted = "good",
        largest_gap_s: float | None = None,
    ) -> AttitudeAt:
        """The attitude of a spacecraft at a moment; see `moment.attitude_at`."""
        about = self.attitudes(name, run=run, status=status, largest_gap_s=largest_gap_s).about
        gap_s = about.largest_gap_s
        before = ResultFilter(about.run, name, shifted(moment, -gap_s), moment)
        # The end of a period is excluded.
        after = ResultFilter(about.run, name, moment, shifted(moment, gap_s + 1e-6))
        reading = self._context.reading
        earlier = next(attitude_pages(reading, before, newest_first=True, page=AROUND), None)
        later = next(attitude_pages(reading, after, page=AROUND), None)
        pages = [
            *([] if earlier is None else [earlier.taken(slice(None, None, -1))]),
            *([] if later is None else [later]),
        ]
        return attitude_at(about, pages, moment, method)

    def table(
        self,
        name: str,
        kind: TableKind,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
    ) -> Table:
        """A spacecraft's batches or their stars, oldest first; see `result_tables`."""
        mission_named(self._context.missions, name)
        selected = ResultFilter(run or LIVE, name, start, end)
        about = {
            "spacecraft": name,
            "run": selected.run or LIVE,
            "start": "" if start is None else start.text,
            "end": "" if end is None else end.text,
            "created": utc_now().text,
            "originator": f"attitude-acquisition {__version__}",
        }
        return _TABLES[kind](self._context.reading, selected, about)


def _require_at_most(most: int, count: int) -> None:
    if count > most:
        message = f"the period has more than the {most:,} batches that a file of this format takes"
        raise BadBatch(Fault("start", f"{message}; choose a shorter one"))
