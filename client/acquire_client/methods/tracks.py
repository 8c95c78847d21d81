"""Client methods: tracks."""
# Written by `make client` from service/features/tracks/routes.py.

from .. import models
from ..calls import Call, model, single_request, text
from ..encoding import Time, path_of


class TracksMethods:
    """Methods for the routes of `service/features/tracks/routes.py` of the service."""

    @single_request
    def tracks(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Call[models.TrackList]:
        """The tracks in a period: points without a catalog star that move together.

        They are computed from the record: unmatched stars of the batches with an attitude, of at
        most 2,000 batches. As `tdm` the moving ones are a CCSDS TDM of right ascensions and
        declinations; 404 if there are none.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.

        >>> [each.kind for each in client.tracks("XTE").items]
        []
        """
        path = path_of("spacecraft", spacecraft, "tracks")
        query = {"run": run, "start": start, "end": end}
        return Call(model(models.TrackList), "GET", path, query=query)

    @single_request
    def tracks_tdm(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Call[str]:
        """The tracks in a period: points without a catalog star that move together.

        They are computed from the record: unmatched stars of the batches with an attitude, of at
        most 2,000 batches. As `tdm` the moving ones are a CCSDS TDM of right ascensions and
        declinations; 404 if there are none.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.
        """
        path = path_of("spacecraft", spacecraft, "tracks")
        query = {"run": run, "start": start, "end": end, "format": "tdm"}
        return Call(text, "GET", path, query=query)
