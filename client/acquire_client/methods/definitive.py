"""Client methods: definitive."""
# Written by `make client` from service/features/definitive/routes.py.

from .. import models
from ..calls import Call, Listing, model, paged_list, single_request
from ..encoding import Time, parameters_of, path_of


class DefinitiveMethods:
    """Methods for the routes of `service/features/definitive/routes.py` of the service."""

    @single_request
    def live_attitude(self, spacecraft: str) -> Call[models.LiveAttitude]:
        """The filtered attitude at the last epoch of live data, for missions with a live filter.

        404 if the mission has no live filter, or if there is no attitude yet, or it is lost.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        """
        path = path_of("spacecraft", spacecraft, "attitude", "latest")
        return Call(model(models.LiveAttitude), "GET", path)

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
        """Queue a job that filters and smooths recorded days, and records both results.

        A day whose record has not changed stays as it is; one with later batches gets a new
        revision.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        """
        path = path_of("spacecraft", spacecraft, "definitive-attitude")
        body = {"run": run, "start": start, "end": end, "who": who}
        return Call(model(models.DefinitiveJob), "POST", path, body=parameters_of(body))

    @single_request
    def definitive_attitude(self, spacecraft: str, id: str) -> Call[models.DefinitiveJob]:
        """State and progress of a definitive-attitude job.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `id`: The `id` of a job.
        """
        path = path_of("spacecraft", spacecraft, "definitive-attitude", id)
        return Call(model(models.DefinitiveJob), "GET", path)

    @paged_list
    def innovations(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Listing[models.Innovation]:
        """Differences of measured attitudes from the filter's prediction and the smoothed attitude.

        They are of the days that `acquire smooth` recorded, the latest revision of each.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.

        >>> [row.chi_square for row in client.innovations("XTE")]
        []
        """
        path = path_of("spacecraft", spacecraft, "innovations")
        query = {"run": run, "start": start, "end": end}
        return Listing(models.Innovation, path, query)
