"""Client methods for spacecraft: state, attitudes, trends and gyro blocks."""

from collections.abc import Sequence

from . import models
from .calls import Call, Listing, get, get_items, paged_list, post, single_request
from .encoding import Batch, Time, path_of
from .retrying import Repeat


class Spacecraft:
    """Client methods for spacecraft; the `end` of each period is excluded."""

    @single_request
    def fleet(self, *, run: str = "live") -> Call[list[models.SpacecraftRow]]:
        """List all spacecraft with their state in a run.

        >>> [each.name for each in client.fleet() if each.attitude]
        ['XTE']
        """
        return get_items(models.SpacecraftRow, path_of("spacecraft"), {"run": run})

    @single_request
    def spacecraft(self, name: str, *, run: str = "live") -> Call[models.SpacecraftState]:
        """Read a spacecraft's state in a run, with its mission's settings and their history."""
        return get(models.SpacecraftState, path_of("spacecraft", name), {"run": run})

    @paged_list
    def attitudes(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Listing[models.AttitudeRow]:
        """List the attitudes of a run, oldest first by batch time, suspect ones included.

        >>> [round(row.quaternion[3], 4) for row in client.attitudes("XTE")]
        [0.3536]
        >>> table = client.attitudes("XTE").to_arrow()
        >>> table.num_rows
        1
        """
        query = {"run": run, "start": start, "end": end}
        return Listing(models.AttitudeRow, path_of("spacecraft", spacecraft, "attitudes"), query)

    @single_request
    def live_attitude(self, spacecraft: str) -> Call[models.LiveAttitude]:
        """Read the filtered attitude at the last epoch, for a mission with a live filter."""
        return get(models.LiveAttitude, path_of("spacecraft", spacecraft, "attitude", "latest"))

    @single_request
    def make_definitive_attitude(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        who: str | None = None,
    ) -> Call[models.DefinitiveJob]:
        """Start a job that filters and smooths the days of a period in the background."""
        asked = {"run": run, "start": start, "end": end, "who": who}
        path = path_of("spacecraft", spacecraft, "definitive-attitude")
        return post(models.DefinitiveJob, path, asked)

    @single_request
    def definitive_attitude(self, spacecraft: str, id: str) -> Call[models.DefinitiveJob]:
        """Read the progress of a job that computes a definitive attitude."""
        path = path_of("spacecraft", spacecraft, "definitive-attitude", id)
        return get(models.DefinitiveJob, path)

    @paged_list
    def innovations(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Listing[models.Innovation]:
        """List the innovations of a period: measured less predicted attitudes in the filter.

        Only days that `acquire smooth` recorded have them.

        >>> [row.chi_square for row in client.innovations("XTE")]
        []
        """
        query = {"run": run, "start": start, "end": end}
        return Listing(models.Innovation, path_of("spacecraft", spacecraft, "innovations"), query)

    @single_request
    def tracks(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Call[models.TrackList]:
        """List tracks of points that no catalog star explains: objects, planets, hot pixels.

        The period has at most 2,000 batches.

        >>> [each.kind for each in (client.tracks("XTE")).items]
        []
        """
        query = {"run": run, "start": start, "end": end}
        return get(models.TrackList, path_of("spacecraft", spacecraft, "tracks"), query)

    @single_request
    def tracks_tdm(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Call[str]:
        """Read the moving tracks of a period as a CCSDS TDM; raises `NotFound` without any."""
        query = {"run": run, "start": start, "end": end, "format": "tdm"}
        path = path_of("spacecraft", spacecraft, "tracks")
        return Call(lambda response: response.text, "GET", path, query)

    @single_request
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
    ) -> Call[models.History]:
        """Read quantities over a period, reduced to at most `size` points; default: all, 500.

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
        return get(models.History, path_of("spacecraft", spacecraft, "history"), query)

    @single_request
    def rates(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        bucket: str = "hour",
    ) -> Call[list[models.Rates]]:
        """Read the stars by outcome for each hour or day with batches, oldest first.

        >>> [(each.start, each.observed) for each in client.rates("XTE")]
        [('1996-01-10T12:00:00.000Z', 4)]
        """
        query = {"run": run, "start": start, "end": end, "bucket": bucket}
        return get_items(models.Rates, path_of("spacecraft", spacecraft, "rates"), query)

    @single_request
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
    ) -> Call[models.Ranking]:
        """Read the batches with the worst values of a quantity in a period, worst first."""
        query = {
            "by": by,
            "run": run,
            "start": start,
            "end": end,
            "tracker": tracker,
            "limit": limit,
        }
        return get(models.Ranking, path_of("spacecraft", spacecraft, "worst"), query)


class Gyro:
    """Client methods for gyro blocks."""

    @single_request
    def submit_gyro(self, spacecraft: str, block: Batch) -> Call[models.GyroBlock]:
        """Record a block of up to 10,000 samples of rates in rad/s.

        Spacecraft, run and block identify it: to send it again is harmless, and gives the
        recorded block.  Raises `BadInput` naming each field, `Conflict` where another body has
        the name, or another block one of the times.

        >>> sorted(block)
        ['block', 'rates_rad_per_s', 'start', 'step_s']
        >>> recorded = client.submit_gyro("XTE", block)
        >>> recorded.end, recorded.samples
        ('1996-01-10T12:00:00.500Z', 2)
        """
        path = path_of("spacecraft", spacecraft, "gyro")
        return post(models.GyroBlock, path, block, Repeat.ALWAYS)

    @paged_list
    def gyro(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Listing[models.GyroBlock]:
        """List the gyro blocks that overlap a period, the earliest first; `end` is excluded.

        >>> recorded = client.submit_gyro("XTE", block)
        >>> [found.block for found in client.gyro("XTE")]
        ['g1']
        """
        query = {"run": run, "start": start, "end": end}
        return Listing(models.GyroBlock, path_of("spacecraft", spacecraft, "gyro"), query)

    @single_request
    def gyro_samples(self, spacecraft: str, id: str) -> Call[models.GyroSamples]:
        """Read a gyro block with its samples; raises `NotFound`.

        >>> recorded = client.submit_gyro("XTE", block)
        >>> samples = client.gyro_samples("XTE", recorded.id)
        >>> samples.times_s, samples.rates_rad_per_s[1]
        ([0.0, 0.5], [0.0011, 0.0, 1e-05])
        """
        return get(models.GyroSamples, path_of("spacecraft", spacecraft, "gyro", id))
