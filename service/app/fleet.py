"""Spacecraft: state, attitudes, rates of stars, worst batches, histories, and their tables."""

from collections.abc import Collection, Iterator, Sequence
from functools import partial
from itertools import chain
from typing import Any, Unpack

from msgspec import UNSET, structs
from sqlalchemy import Connection

from service.app.context import Context, PageOfPeriod
from service.contract import spacecraft as records
from service.contract.alarms import Alarm
from service.contract.base import Page
from service.contract.spacecraft import Overview
from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Mission
from service.observations.schema import LIVE
from service.storage.queries import fleet, histories, time_buckets, trends
from service.storage.queries.pages import ResultFilter
from service.storage.queries.trends import worst_batches
from service.storage.recording.result_metrics import is_waiting
from service.table_files.table import Column, Table
from service.table_files.table import Page as TablePage
from service.times import Utc, utc_now, utc_of_unix
from service.trends.quantities import QUANTITIES, QuantityName, tracker_names, trend_names


class Spacecraft:
    """Service that reads the data of spacecraft in a run, by default the live one."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def overview(
        self, run: str | None = None, spacecraft: Collection[str] | None = None
    ) -> Overview:
        """Overview of all spacecraft in a run, or of some; see `fleet.overview`."""
        with self._context.reading() as connection:
            missions, name = self._context.known.values(), run or LIVE
            active = self._context.active_alarms(connection, name)
            return fleet.overview(connection, missions, name, utc_now(), active, spacecraft)

    def fleet(
        self,
        names: Sequence[str],
        run: str,
        period: fleet.Period,
        spacecraft: Collection[str] | None = None,
    ) -> fleet.Fleet:
        """State of some spacecraft in a run, for a page of the fleet; see `fleet.fleet`."""
        missions = [self._context.known[name] for name in names]
        with self._context.reading() as connection:
            active = self._context.active_alarms(connection, run)
            return fleet.fleet(connection, missions, run, period, utc_now(), active, spacecraft)

    def alarms(self, run: str) -> list[Alarm]:
        """Alarms of a run that are not cleared, the worst present severity first."""
        with self._context.reading() as connection:
            return self._context.active_alarms(connection, run)

    def states(
        self, run: str | None = None, spacecraft: Collection[str] | None = None
    ) -> list[records.SpacecraftRow]:
        """State of all spacecraft in a run, retired ones included, or of some alone."""
        known = self._context.known.values()
        missions = [each for each in known if spacecraft is None or each.name in spacecraft]
        with self._context.reading() as connection:
            return self._states(connection, missions, run or LIVE, spacecraft)

    def state(
        self, name: str, run: str | None = None, spacecraft: Collection[str] | None = None
    ) -> records.SpacecraftState:
        """State of one spacecraft in a run, its mission's settings and their history."""
        mission = self._context.mission(name)
        with self._context.reading() as connection:
            (state,) = self._states(connection, [mission], run or LIVE, spacecraft)
            settings = mission.model_dump(mode="json")
            return records.SpacecraftState(
                **structs.asdict(state),
                mission=records.MissionNow(digest=mission.digest, settings=settings),
                history=histories.mission_history(connection, name),
            )

    def _states(
        self,
        connection: Connection,
        missions: Sequence[Mission],
        run: str,
        spacecraft: Collection[str] | None,
    ) -> list[records.SpacecraftRow]:
        now, active = utc_now(), self._context.active_alarms(connection, run)
        _, rows = fleet.fleet_rows(connection, missions, run, now, active, spacecraft)
        return [
            histories.live_state(connection, mission, run, now, row.faults)
            for mission, row in zip(missions, rows, strict=True)
        ]

    def attitudes(self, name: str, **asked: Unpack[PageOfPeriod]) -> Page[records.AttitudeRow]:
        """Page of a spacecraft's attitudes from current results, oldest batch time first."""
        listing = partial(histories.list_attitudes, archive=self._context.store.archive)
        return self._context.page(listing, ResultFilter, name, asked)

    def rates(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        bucket: time_buckets.Bucket = "hour",
    ) -> list[records.Rates]:
        """Counts of stars by outcome and of batches, in UTC hours or days by batch time.

        Raises `BadInput` for a period with too many hours or days.
        """
        self._context.mission(name)
        with self._context.reading() as connection:
            return time_buckets.rates(
                connection, name, run=run or LIVE, start=start, end=end, bucket=bucket
            )

    def history(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        strategy: trends.Strategy = "minmax",
        size: int = 500,
        quantities: Sequence[QuantityName] = (),
        tracker: str | None = None,
    ) -> records.History:
        """Histories of quantities, by default of all, in at most `size` points each.

        `minmax` gives buckets with mean, least and greatest, `latest` the newest batches one by
        one; see `trends.history`.  With a tracker they are the tracker's own values.
        """
        mission = self._context.mission(name)
        names = _quantities(quantities, tracker)
        own = self._split_tracker(mission, tracker)
        asked = trends.HistoryRequest(name, run or LIVE, start, end, names, strategy, size, own)
        with self._context.reading() as connection:
            found = trends.history(connection, asked)
            return structs.replace(found, **_named(connection, mission, run or LIVE, tracker))

    def every_batch(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        quantities: Sequence[QuantityName] = (),
        tracker: str | None = None,
    ) -> Iterator[records.History]:
        """History of quantities over every batch of a period, in pages; see `trends`."""
        mission = self._context.mission(name)
        names = _quantities(quantities, tracker)
        own = self._split_tracker(mission, tracker)
        asked = trends.HistoryRequest(name, run or LIVE, start, end, names, tracker=own)
        return trends.every_batch(self._context.reading, asked)

    def ranking(
        self,
        name: str,
        *,
        by: QuantityName,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 20,
        tracker: str | None = None,
    ) -> records.Ranking:
        """Batches of a period with the worst values of a quantity, worst first.

        With a tracker they are ranked by its own values.
        """
        mission = self._context.mission(name)
        _quantities((by,), tracker, "by")
        stretch = ResultFilter(run or LIVE, name, start, end)
        with self._context.reading() as connection:
            own = self._split_tracker(mission, tracker)
            items = worst_batches(connection, stretch, by, limit, own)
            return records.Ranking(
                by=by, items=items, **_named(connection, mission, run or LIVE, tracker)
            )

    def _split_tracker(self, mission: Mission, tracker: str | None) -> str | None:
        """Tracker whose own values are read; None if they are those of the spacecraft.

        The values of a single tracker are the spacecraft's.  Raises `BadInput` for a tracker that
        the mission never had.
        """
        if tracker is None or tracker in self._context.trackers(mission.name):
            return tracker
        mission.tracker(tracker, "tracker")
        return None


def _quantities(
    named: Sequence[QuantityName], tracker: str | None, field: str = "quantity"
) -> tuple[QuantityName, ...]:
    """Names of the requested quantities, or of all; `BadBatch` for one that trackers lack."""
    if tracker is None:
        return tuple(named) or trend_names()
    for name in named:
        if name not in tracker_names():
            known = ", ".join(tracker_names())
            raise BadBatch(Fault(field, f"a tracker has {known} only", shown_value(name)))
    return tuple(named) or tracker_names()


def _named(
    connection: Connection, mission: Mission, run: str, tracker: str | None
) -> dict[str, Any]:
    """Fields about a tracker in an answer: its name, and True while batches are not split."""
    if tracker is None:
        return {"tracker": UNSET, "not_split": UNSET}
    waits = len(mission.trackers) > 1 and is_waiting(connection, mission.name, run)
    return {"tracker": tracker, "not_split": waits}


BATCH_COLUMNS = (
    Column("time", "utc", description="UTC. Time of the batch.", width=30),
    Column("batch", "text", description="Name of the batch.", width=128),
    Column("id", "text", description="Id of the result.", width=26),
)
BUCKET_COLUMNS = (
    Column("start", "utc", description="UTC. Start of the bucket.", width=30),
    Column("bucket_s", "integer", "s", description="Width of the bucket."),
    Column("batches", "integer", description="Batches in the bucket."),
)
BUCKET_PARTS = {
    "count": "batches with a value",
    "mean": "mean",
    "min": "least of a batch",
    "max": "greatest of a batch",
}


def history_table(history: records.History) -> Table:
    """Convert a history of quantities to a table; see `trends.history`."""
    if history.strategy == "latest":
        return batch_table(iter([history]))
    columns = [
        _column(name, part, meaning)
        for name in history.series
        for part, meaning in BUCKET_PARTS.items()
    ]
    starts = [utc_of_unix(each).text for each in history.unix_s]
    page: list[Any] = [starts, [history.bucket_s] * len(starts), history.batches]
    page += [getattr(each, part) for each in history.series.values() for part in BUCKET_PARTS]
    return Table([*BUCKET_COLUMNS, *columns], [page], _about(history))


def batch_table(pages: Iterator[records.History]) -> Table:
    """Convert pages of batches in a history to a table; see `trends.every_batch`.

    The first page is read at once: its errors are raised here.
    """
    first = next(pages)
    columns = [*BATCH_COLUMNS, *(_column(name) for name in first.series)]
    return Table(columns, (_batch_page(page) for page in chain([first], pages)), _about(first))


def _batch_page(page: records.History) -> TablePage:
    values: list[Any] = [each.value for each in page.series.values()]
    return [*(getattr(page, each.name) for each in BATCH_COLUMNS), *values]


def _column(name: QuantityName, part: str = "", meaning: str = "") -> Column:
    quantity = QUANTITIES[name]
    about = f"{quantity.label}: {meaning}" if meaning else quantity.label
    if part == "count":
        return Column(f"{name}_count", "integer", description=about)
    return Column(f"{name}_{part}" if part else name, unit=quantity.unit, description=about)


def _about(history: records.History) -> dict[str, str]:
    return {
        "product": "history",
        "spacecraft": history.spacecraft,
        "run": history.run,
        "start": history.start or "",
        "end": history.end or "",
    }
