"""Spacecraft: state, attitudes and trends."""

from collections.abc import Sequence

from ..base import Page
from ..encoding import Time, path_of
from ..models import (
    AttitudeRow,
    DefinitiveJob,
    History,
    Innovation,
    LiveAttitude,
    Ranking,
    Rates,
    SpacecraftRow,
    SpacecraftState,
    TrackList,
)
from .connection import Connection
from .pages import Items


class Spacecraft(Connection):
    """The part of the client that is about spacecraft.  In each period `end` is excluded."""

    def fleet(self, *, run: str = "live") -> list[SpacecraftRow]:
        """Every spacecraft with its state in a run.

        >>> [each.name for each in client.fleet() if each.attitude]
        ['XTE']
        """
        page = self.get(Page[SpacecraftRow], path_of("spacecraft"), {"run": run})
        return page.items

    def spacecraft(self, name: str, *, run: str = "live") -> SpacecraftState:
        """One spacecraft: state in a run, mission settings and their history."""
        return self.get(SpacecraftState, path_of("spacecraft", name), {"run": run})

    def attitudes(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Items[AttitudeRow]:
        """The attitudes of a run, oldest first by batch time, suspect ones included.

        >>> [round(row.quaternion[3], 4) for row in client.attitudes("XTE")]
        [0.3536]
        >>> table = client.attitudes("XTE").to_arrow()
        >>> table.num_rows
        1
        """
        query = {"run": run, "start": start, "end": end}
        return Items(self, AttitudeRow, path_of("spacecraft", spacecraft, "attitudes"), query)

    def live_attitude(self, spacecraft: str) -> LiveAttitude:
        """The filtered attitude at the last epoch, of a mission with a live filter."""
        return self.get(LiveAttitude, path_of("spacecraft", spacecraft, "attitude", "latest"))

    def make_definitive_attitude(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        who: str | None = None,
    ) -> DefinitiveJob:
        """Let the service filter and smooth the days of a period; the job goes on beside it."""
        asked = {"run": run, "start": start, "end": end, "who": who}
        path = path_of("spacecraft", spacecraft, "definitive-attitude")
        return self.post(DefinitiveJob, path, asked)

    def definitive_attitude(self, spacecraft: str, id: str) -> DefinitiveJob:
        """How far a job is that makes a definitive attitude."""
        path = path_of("spacecraft", spacecraft, "definitive-attitude", id)
        return self.get(DefinitiveJob, path)

    def innovations(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Items[Innovation]:
        """How the attitudes of a period met the filter, the earliest first.

        There are some of the days that `acquire smooth` recorded.

        >>> [row.chi_square for row in client.innovations("XTE")]
        []
        """
        query = {"run": run, "start": start, "end": end}
        return Items(self, Innovation, path_of("spacecraft", spacecraft, "innovations"), query)

    def tracks(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> TrackList:
        """Tracks of points that no catalog star explains: objects, planets, hot pixels.

        The period has at most 2,000 batches.

        >>> [each.kind for each in (client.tracks("XTE")).items]
        []
        """
        query = {"run": run, "start": start, "end": end}
        return self.get(TrackList, path_of("spacecraft", spacecraft, "tracks"), query)

    def tracks_tdm(
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
        return (self.request("GET", path, query=query)).text

    def history(
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
    ) -> History:
        """Quantities over a period, thinned out to at most `size` points; default: all, 500.

        `strategy` is `minmax` for buckets, `latest` for the newest batches one by one.

        >>> history = client.history("XTE", ["residual_rms_arcsec"])
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
        return self.get(History, path_of("spacecraft", spacecraft, "history"), query)

    def rates(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        bucket: str = "hour",
    ) -> list[Rates]:
        """Stars by outcome for each hour or day with batches, oldest first.

        >>> [(each.start, each.observed) for each in client.rates("XTE")]
        [('1996-01-10T12:00:00.000Z', 4)]
        """
        query = {"run": run, "start": start, "end": end, "bucket": bucket}
        page = self.get(Page[Rates], path_of("spacecraft", spacecraft, "rates"), query)
        return page.items

    def worst(
        self,
        spacecraft: str,
        by: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        tracker: str | None = None,
        limit: int = 20,
    ) -> Ranking:
        """The batches with the worst values of a quantity in a period, worst first."""
        query = {
            "by": by,
            "run": run,
            "start": start,
            "end": end,
            "tracker": tracker,
            "limit": limit,
        }
        return self.get(Ranking, path_of("spacecraft", spacecraft, "worst"), query)
