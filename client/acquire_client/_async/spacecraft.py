"""Spacecraft: state, attitudes, trends and gyro blocks."""

from collections.abc import Sequence

from .. import models
from ..base import Page
from ..encoding import Batch, Time, path_of
from ..retrying import Repeat
from .connection import AsyncConnection, AsyncItems


class AsyncSpacecraft(AsyncConnection):
    """The part of the client that is about spacecraft.  In each period `end` is excluded."""

    async def fleet(self, *, run: str = "live") -> list[models.SpacecraftRow]:
        """Every spacecraft with its state in a run.

        >>> [each.name for each in await client.fleet() if each.attitude]
        ['XTE']
        """
        page = await self.get(Page[models.SpacecraftRow], path_of("spacecraft"), {"run": run})
        return page.items

    async def spacecraft(self, name: str, *, run: str = "live") -> models.SpacecraftState:
        """One spacecraft: state in a run, mission settings and their history."""
        return await self.get(models.SpacecraftState, path_of("spacecraft", name), {"run": run})

    def attitudes(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> AsyncItems[models.AttitudeRow]:
        """The attitudes of a run, oldest first by batch time, suspect ones included.

        >>> [round(row.quaternion[3], 4) async for row in client.attitudes("XTE")]
        [0.3536]
        >>> table = await client.attitudes("XTE").to_arrow()
        >>> table.num_rows
        1
        """
        query = {"run": run, "start": start, "end": end}
        return AsyncItems(
            self, models.AttitudeRow, path_of("spacecraft", spacecraft, "attitudes"), query
        )

    async def live_attitude(self, spacecraft: str) -> models.LiveAttitude:
        """The filtered attitude at the last epoch, of a mission with a live filter."""
        return await self.get(
            models.LiveAttitude, path_of("spacecraft", spacecraft, "attitude", "latest")
        )

    async def make_definitive_attitude(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        who: str | None = None,
    ) -> models.DefinitiveJob:
        """Let the service filter and smooth the days of a period; the job goes on beside it."""
        asked = {"run": run, "start": start, "end": end, "who": who}
        path = path_of("spacecraft", spacecraft, "definitive-attitude")
        return await self.post(models.DefinitiveJob, path, asked)

    async def definitive_attitude(self, spacecraft: str, id: str) -> models.DefinitiveJob:
        """How far a job is that makes a definitive attitude."""
        path = path_of("spacecraft", spacecraft, "definitive-attitude", id)
        return await self.get(models.DefinitiveJob, path)

    def innovations(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> AsyncItems[models.Innovation]:
        """How the attitudes of a period met the filter, the earliest first.

        There are some of the days that `acquire smooth` recorded.

        >>> [row.chi_square async for row in client.innovations("XTE")]
        []
        """
        query = {"run": run, "start": start, "end": end}
        return AsyncItems(
            self, models.Innovation, path_of("spacecraft", spacecraft, "innovations"), query
        )

    async def tracks(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> models.TrackList:
        """Tracks of points that no catalog star explains: objects, planets, hot pixels.

        The period has at most 2,000 batches.

        >>> [each.kind for each in (await client.tracks("XTE")).items]
        []
        """
        query = {"run": run, "start": start, "end": end}
        return await self.get(models.TrackList, path_of("spacecraft", spacecraft, "tracks"), query)

    async def tracks_tdm(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> str:
        """The moving tracks of a period as a CCSDS TDM; raises `NotFound` if there are none."""
        query = {"run": run, "start": start, "end": end, "format": "tdm"}
        path = path_of("spacecraft", spacecraft, "tracks")
        return (await self.request("GET", path, query=query)).text

    async def history(
        self,
        spacecraft: str,
        quantities: Sequence[str] = (),
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        tracker: str | None = None,
        strategy: str | None = None,
        size: int | None = None,
    ) -> models.History:
        """Quantities over a period, thinned out to at most `size` points; default: all, 500.

        `strategy` is `minmax` for buckets, `latest` for the newest batches one by one.

        >>> history = await client.history("XTE", ["residual_rms_arcsec"])
        >>> history.to_arrow().column_names[-1]
        'residual_rms_arcsec.max'
        """
        query = {
            "quantity": list(quantities),
            "run": run,
            "start": start,
            "end": end,
            "tracker": tracker,
            "strategy": strategy,
            "size": size,
        }
        return await self.get(models.History, path_of("spacecraft", spacecraft, "history"), query)

    async def rates(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        bucket: str = "hour",
    ) -> list[models.Rates]:
        """Stars by outcome for each hour or day with batches, oldest first.

        >>> [(each.start, each.observed) for each in await client.rates("XTE")]
        [('1996-01-10T12:00:00.000Z', 4)]
        """
        query = {"run": run, "start": start, "end": end, "bucket": bucket}
        page = await self.get(Page[models.Rates], path_of("spacecraft", spacecraft, "rates"), query)
        return page.items

    async def worst(
        self,
        spacecraft: str,
        by: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        tracker: str | None = None,
        limit: int = 20,
    ) -> models.Ranking:
        """The batches with the worst values of a quantity in a period, worst first."""
        query = {
            "by": by,
            "run": run,
            "start": start,
            "end": end,
            "tracker": tracker,
            "limit": limit,
        }
        return await self.get(models.Ranking, path_of("spacecraft", spacecraft, "worst"), query)


class AsyncGyro(AsyncConnection):
    """The part of the client that is about gyro blocks."""

    async def submit_gyro(self, spacecraft: str, block: Batch) -> models.GyroBlock:
        """Record a block of up to 10,000 samples of rates in rad/s.

        Spacecraft, run and block identify it: to send it again is harmless, and gives the
        recorded block.  Raises `BadInput` naming each field, `Conflict` where another body has
        the name, or another block one of the times.

        >>> sorted(block)
        ['block', 'rates_rad_per_s', 'start', 'step_s']
        >>> recorded = await client.submit_gyro("XTE", block)
        >>> recorded.end, recorded.samples
        ('1996-01-10T12:00:00.500Z', 2)
        """
        path = path_of("spacecraft", spacecraft, "gyro")
        return await self.post(models.GyroBlock, path, block, Repeat.ALWAYS)

    def gyro(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> AsyncItems[models.GyroBlock]:
        """The blocks that touch a period, the earliest first; `end` is excluded.

        >>> recorded = await client.submit_gyro("XTE", block)
        >>> [found.block async for found in client.gyro("XTE")]
        ['g1']
        """
        query = {"run": run, "start": start, "end": end}
        return AsyncItems(self, models.GyroBlock, path_of("spacecraft", spacecraft, "gyro"), query)

    async def gyro_samples(self, spacecraft: str, id: str) -> models.GyroSamples:
        """One block with its samples; raises `NotFound`.

        >>> recorded = await client.submit_gyro("XTE", block)
        >>> samples = await client.gyro_samples("XTE", recorded.id)
        >>> samples.times_s, samples.rates_rad_per_s[1]
        ([0.0, 0.5], [0.0011, 0.0, 1e-05])
        """
        return await self.get(models.GyroSamples, path_of("spacecraft", spacecraft, "gyro", id))
