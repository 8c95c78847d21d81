"""Service that reads attitudes and tables of a spacecraft for export."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from sqlalchemy import Connection

from service import __version__
from service.app.factory import App
from service.ephemerides.rows import AttitudeRows
from service.errors import BadBatch, Fault
from service.features.products import attitudes as attitude_series
from service.features.products.moment import AtMethod, AttitudeAt, attitude_at
from service.features.products.result_tables import attitude_pages, batch_table, star_table
from service.ingest.missions_in_force import adopted_missions
from service.missions.mission import Mission, load_missions, mission_named
from service.missions.product_settings import MAX_LARGEST_GAP_S
from service.observations.schema import LIVE
from service.settings import Settings
from service.storage.gyro import BlockFilter, count_samples, sample_table
from service.storage.projections.heads import newest_head
from service.storage.queries.definitive import count_samples_of, definitive_pages, made_at
from service.storage.queries.histories import retired
from service.storage.queries.pages import ResultFilter, count
from service.storage.store import Store
from service.table_files.table import Table
from service.times import Utc, shifted, utc_now

Pages = Iterator[AttitudeRows]
Order = Literal["oldest", "newest"]
AROUND = 200
"""Number of batches on either side of a time that are read to find its attitude."""
CADENCES = 2.5
"""Default largest gap within an interval, in usual times between batches."""
LEAST_OF_CADENCE = 4
"""Least number of batches from which the usual time between them is estimated."""
TableKind = Literal["batches", "stars", "gyro"]
TABLE_KINDS: tuple[TableKind, ...] = get_args(TableKind)
_TABLES = {"batches": batch_table, "stars": star_table}


class Products:
    """Reads attitudes and tables for export."""

    def __init__(self, missions: Mapping[str, Mission], store: Store) -> None:
        self._missions = missions
        self._store = store

    def close(self) -> None:
        """Do nothing on closing: no file and no connection is open."""

    def attitudes(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        status: attitude_series.StatusWanted = "good",
        grade: attitude_series.ProductGrade = "raw",
        order: Order = "oldest",
        largest_gap_s: float | None = None,
        object_id: str | None = None,
        naif_id: int | None = None,
        most_batches: int | None = None,
    ) -> attitude_series.AttitudeSeries:
        """Series of a spacecraft's current attitudes in a run; see `series_of`.

        The grades `filtered` and `smoothed` are read from the latest revision of each day.  Rows
        are read while the series is iterated.  The largest gap and the identifiers are the
        mission's if they are None.  For a mission that sets no gap, the gap follows the cadence of
        the period's batches, so that batches at a steady cadence form one interval.  Raises
        `BadBatch` for a period with more than `most_batches`.
        """
        mission = mission_named(self._missions, name)
        own = mission.products
        about = attitude_series.SeriesInfo(
            spacecraft=name,
            run=run or LIVE,
            created=utc_now().text,
            version=__version__,
            start=None if start is None else start.text,
            end=None if end is None else end.text,
            status=status,
            grade=grade,
            newest_first=order == "newest",
            largest_gap_s=own.largest_gap_s if largest_gap_s is None else largest_gap_s,
            object_id=own.object_id if object_id is None else object_id,
            naif_id=own.naif_id if naif_id is None else naif_id,
            # The mission's clock is that of its own id.
            sclk_kernel=own.sclk_kernel if naif_id in (None, own.naif_id) else None,
            record_head=self._record_head(),
            trackers=tuple(
                attitude_series.SeriesTracker(
                    each.name, tuple(map(tuple, each.body_from_tracker.tolist())), each.sigma_arcsec
                )
                for each in mission.trackers
            ),
        )
        selected = ResultFilter(about.run, name, start, end)
        if grade == "raw":
            self._require_few_batches(selected, most_batches)
        else:
            self._require_few(
                lambda each: count_samples_of(each, selected, grade), most_batches, "samples"
            )
        if grade == "raw" and largest_gap_s is None and not own.names_gap:
            about = replace(about, largest_gap_s=self._gap_of_cadence(about, selected))
        pages = self._pages(about, selected, newest_first=about.newest_first)
        return attitude_series.series_of(about, pages)

    def made_at(self, name: str, run: str, start: Utc, end: Utc) -> Utc | None:
        """Time when the newest definitive attitude of a period's days was made; None: of none."""
        with self._store.reading() as connection:
            return made_at(connection, ResultFilter(run, name, start, end))

    def _record_head(self) -> str:
        with self._store.reading() as connection:
            newest = newest_head(connection)
        return "" if newest is None else newest.text

    def _gap_of_cadence(self, about: attitude_series.SeriesInfo, selected: ResultFilter) -> float:
        """Largest gap of a period, estimated from the usual time between its first batches."""
        first = next(self._pages(about, selected, page=AROUND), None)
        if first is None or len(first) < LEAST_OF_CADENCE:
            return about.largest_gap_s
        usual_s = float(np.median(np.abs(np.diff(first.time_ns)))) * 1e-9
        return min(MAX_LARGEST_GAP_S, max(about.largest_gap_s, CADENCES * usual_s))

    def _pages(
        self, about: attitude_series.SeriesInfo, selected: ResultFilter, **wanted: Any
    ) -> Pages:
        """Read recorded attitudes of a period in a grade, page by page."""
        if about.grade == "raw":
            return attitude_pages(self._store.reading, self._store.archive, selected, **wanted)
        return definitive_pages(self._store.reading, selected, about.grade, **wanted)

    def attitude_at(
        self,
        name: str,
        moment: Utc,
        method: AtMethod,
        *,
        run: str | None = None,
        status: attitude_series.StatusWanted = "good",
        grade: attitude_series.ProductGrade = "raw",
        largest_gap_s: float | None = None,
    ) -> AttitudeAt:
        """Attitude of a spacecraft at a given time; see `moment.attitude_at`."""
        if largest_gap_s is None:
            largest_gap_s = mission_named(self._missions, name).products.largest_gap_s
        about = self.attitudes(
            name, run=run, status=status, grade=grade, largest_gap_s=largest_gap_s
        ).about
        gap_s = about.largest_gap_s
        before = ResultFilter(about.run, name, shifted(moment, -gap_s), moment)
        # The end of a period is excluded.
        after = ResultFilter(about.run, name, moment, shifted(moment, gap_s + 1e-6))
        earlier = next(self._pages(about, before, newest_first=True, page=AROUND), None)
        later = next(self._pages(about, after, page=AROUND), None)
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
        most_batches: int | None = None,
    ) -> Table:
        """Table of a spacecraft's batches, their stars or its gyro samples, oldest first.

        Rows are read while the table is iterated; see `result_tables` and `samples_table`.  Raises
        `BadBatch` for a period with more than `most_batches` batches or gyro samples.
        """
        mission_named(self._missions, name)
        about = {
            "spacecraft": name,
            "run": run or LIVE,
            "start": "" if start is None else start.text,
            "end": "" if end is None else end.text,
            "created": utc_now().text,
            "originator": f"attitude-acquisition {__version__}",
            "record_head": self._record_head(),
        }
        if kind == "gyro":
            blocks = BlockFilter(name, run or LIVE, start, end)
            self._require_few(
                lambda each: count_samples(each, blocks), most_batches, "gyro samples"
            )
            return sample_table(self._store.reading, blocks, about)
        selected = ResultFilter(run or LIVE, name, start, end)
        self._require_few_batches(selected, most_batches)
        return _TABLES[kind](self._store.reading, self._store.archive, selected, about)

    def _require_few_batches(self, selected: ResultFilter, most: int | None) -> None:
        self._require_few(
            lambda each: count(each, self._store.archive, selected, (most or 0) + 1),
            most,
            "batches",
        )

    def _require_few(
        self, counting: Callable[[Connection], int], most: int | None, counted: str
    ) -> None:
        if most is None:
            return
        with self._store.reading() as connection:
            found = counting(connection)
        if found > most:
            message = (
                f"the period has more than the {most:,} {counted} that a file of this format takes"
            )
            raise BadBatch(Fault("start", f"{message}; choose a shorter one"))


@contextmanager
def open_products(settings: Settings) -> Iterator[Products]:
    """Open a database for export by a command; see `factory.open_app`.

    Without the sky and the solver it needs 80 MB less memory than the whole app.  Raises
    `BadConfiguration` for missions or a database that cannot be used.
    """
    missions = load_missions(*settings.mission_places, shipped=settings.ships_missions)
    store = Store(
        settings.database,
        archive_folder=settings.archive_folder,
        features_off=settings.features_off,
    )
    try:
        with store.reading() as connection:
            missions |= adopted_missions(connection, missions)
            missions |= retired(connection, missions).missions
        yield Products(missions, store)
    finally:
        store.close()


def open_part(app: App) -> Products:
    """Create the export service of an open app."""
    return Products(app.context.known, app.store)
