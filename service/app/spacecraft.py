"""Spacecraft: their state, attitudes, star rates, histories and worst batches."""

from collections.abc import Iterator, Sequence

from msgspec import structs

from service.alarms.quantities import QuantityName, trend_names
from service.app.context import Context
from service.missions.mission import mission_named
from service.storage.models.base import Page
from service.storage.models.overview import Overview
from service.storage.models.spacecraft import (
    AttitudeRow,
    MissionNow,
    Rates,
    SpacecraftRow,
    SpacecraftState,
)
from service.storage.models.trends import History, RankedBatch
from service.storage.queries import histories, overview, trends
from service.storage.queries.future_dated import LIVE
from service.storage.queries.pages import ResultFilter
from service.storage.queries.ranking import worst_batches
from service.storage.recording import rollups
from service.times import Utc, utc_now


class Spacecraft:
    """Reads the records of each spacecraft: of a run, by default of the live one."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def overview(self, run: str | None = None) -> Overview:
        """Every spacecraft in a run at a glance; see `overview.overview`."""
        with self._context.reading() as connection:
            missions = self._context.missions.values()
            return overview.overview(connection, missions, run or LIVE, utc_now())

    def states(self, run: str | None = None) -> list[SpacecraftRow]:
        """Every spacecraft that has a mission file, with its state in a run."""
        moment = utc_now()
        with self._context.reading() as connection:
            return [
                histories.live_state(connection, mission, run or LIVE, moment)
                for mission in self._context.missions.values()
            ]

    def state(self, name: str, run: str | None = None) -> SpacecraftState:
        """One spacecraft's state in a run, its mission's settings and their history."""
        mission = mission_named(self._context.missions, name)
        with self._context.reading() as connection:
            state = histories.live_state(connection, mission, run or LIVE, utc_now())
            settings = mission.model_dump(mode="json")
            return SpacecraftState(
                **structs.asdict(state),
                mission=MissionNow(digest=mission.digest, settings=settings),
                history=histories.mission_history(connection, name),
            )

    def attitudes(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[AttitudeRow]:
        """The attitudes of current results, oldest batch time first."""
        mission_named(self._context.missions, name)
        stretch = ResultFilter(run or LIVE, name, start, end)
        with self._context.reading() as connection:
            return histories.list_attitudes(connection, stretch, limit=limit, cursor=cursor)

    def rates(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        bucket: rollups.Bucket = "hour",
    ) -> list[Rates]:
        """Stars by outcome over all observed ones, in UTC hours or days by batch time.

        Raises `BadInput` for a period with too many of them.
        """
        mission_named(self._context.missions, name)
        with self._context.reading() as connection:
            found = rollups.rates(
                connection, name, run=run or LIVE, start=start, end=end, bucket=bucket
            )
        return [Rates(**each) for each in found]

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
    ) -> History:
        """Histories of quantities, all of them unless named, in at most `size` points each.

        `minmax` gives buckets with mean, least and greatest, `latest` the newest
        batches one by one; see `trends.history`.
        """
        mission_named(self._context.missions, name)
        asked = trends.HistoryRequest(tuple(quantities) or trend_names(), strategy, size)
        with self._context.reading() as connection:
            return trends.history(
                connection, name, run=run or LIVE, start=start, end=end, request=asked
            )

    def every_batch(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        quantities: Sequence[QuantityName] = (),
    ) -> Iterator[History]:
        """The history of every batch of a period, in pages; see `trends.every_batch`."""
        mission_named(self._context.missions, name)
        names = tuple(quantities) or trend_names()
        return trends.every_batch(
            self._context.reading, name, run=run or LIVE, start=start, end=end, quantities=names
        )

    def worst_batches(
        self,
        name: str,
        *,
        by: QuantityName,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 20,
    ) -> list[RankedBatch]:
        """The batches of a period with the worst values of a quantity, worst first."""
        mission_named(self._context.missions, name)
        stretch = ResultFilter(run or LIVE, name, start, end)
        with self._context.reading() as connection:
            return worst_batches(connection, stretch, by, limit)
