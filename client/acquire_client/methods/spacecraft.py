"""Client methods: spacecraft."""
# Written by `make client` from service/web/api/spacecraft.py.

from collections.abc import Sequence

from .. import models
from ..calls import Call, Listing, items, model, paged_list, single_request
from ..encoding import Time, path_of


class SpacecraftMethods:
    """Methods for the routes of `service/web/api/spacecraft.py` of the service."""

    @single_request
    def fleet(self, *, run: str = "live") -> Call[list[models.SpacecraftRow]]:
        """Every spacecraft with a mission file, with its state in a run.

        - `run`: The run; `live` for the batches of pipelines.

        >>> [each.name for each in client.fleet() if each.attitude]
        ['XTE']
        """
        path = path_of("spacecraft")
        query = {"run": run}
        return Call(items(models.SpacecraftRow), "GET", path, query=query)

    @single_request
    def spacecraft(self, name: str, *, run: str = "live") -> Call[models.SpacecraftState]:
        """One spacecraft: state in a run, mission settings and their history.

        - `name`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.
        """
        path = path_of("spacecraft", name)
        query = {"run": run}
        return Call(model(models.SpacecraftState), "GET", path, query=query)

    @paged_list
    def attitudes(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Listing[models.AttitudeRow]:
        """The attitudes of a run, oldest first by batch time.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.

        >>> [round(row.quaternion[3], 4) for row in client.attitudes("XTE")]
        [0.3536]
        >>> client.attitudes("XTE").to_arrow().num_rows
        1
        """
        path = path_of("spacecraft", spacecraft, "attitudes")
        query = {"run": run, "start": start, "end": end}
        return Listing(models.AttitudeRow, path, query)

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
        """Histories of quantities over a period.

        Thinned out to as many points as can be drawn, or as a table of every batch.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `quantities`: A quantity; repeat the parameter for several. Default: all quantities with
          a history.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.
        - `tracker`: Of this tracker's own stars, for the quantities that a tracker has: shares of
          its stars, residuals, magnitude offset; `suspect_share` is then the share of batches in
          which it is the tracker that disagrees.
        - `strategy`: `minmax`: buckets with the mean, and the least and greatest value of a
          batch. `latest`: the newest batches one by one. Default: `minmax`; for a table without
          `size`, `latest`.
        - `size`: Maximum number of points. Default: 500; for a table of single batches, every
          batch of the period.

        >>> history = client.history("XTE", ["residual_rms_arcsec"])
        >>> history.to_arrow().column_names[-1]
        'residual_rms_arcsec.max'
        """
        path = path_of("spacecraft", spacecraft, "history")
        query = {
            "quantity": quantities,
            "run": run,
            "start": start,
            "end": end,
            "tracker": tracker,
            "strategy": strategy,
            "size": size,
        }
        return Call(model(models.History), "GET", path, query=query)

    @single_request
    def latest(self, spacecraft: str, *, run: str = "live") -> Call[models.Result]:
        """The newest current result of a run, by batch time; it may have no attitude.

        A live batch that is dated more than an hour in the future counts only where there is no
        other.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.

        >>> client.latest("XTE").answer.attitude.status
        'good'
        """
        path = path_of("spacecraft", spacecraft, "latest")
        query = {"run": run}
        return Call(model(models.Result), "GET", path, query=query)

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
        """Numbers of stars by outcome, in at most 20,000 buckets of batch time.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.
        - `bucket`: The width of a bucket, in UTC.

        >>> [(each.start, each.observed) for each in client.rates("XTE")]
        [('1996-01-10T12:00:00.000Z', 4)]
        """
        path = path_of("spacecraft", spacecraft, "rates")
        query = {"run": run, "start": start, "end": end, "bucket": bucket}
        return Call(items(models.Rates), "GET", path, query=query)

    @single_request
    def worst(
        self,
        spacecraft: str,
        by: str = "ambiguous_share",
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        tracker: str | None = None,
        limit: int = 20,
    ) -> Call[models.Ranking]:
        """The batches with the worst values of a quantity in a period, worst first.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `by`: The quantity. For an offset, its absolute value.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.
        - `tracker`: Of this tracker's own stars, for the quantities that a tracker has: shares of
          its stars, residuals, magnitude offset; `suspect_share` is then the share of batches in
          which it is the tracker that disagrees.
        - `limit`: Maximum number of items.
        """
        path = path_of("spacecraft", spacecraft, "worst")
        query = {
            "by": by,
            "run": run,
            "start": start,
            "end": end,
            "tracker": tracker,
            "limit": limit,
        }
        return Call(model(models.Ranking), "GET", path, query=query)
