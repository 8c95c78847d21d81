"""Client methods: alarms."""
# Written by `make client` from service/features/alarms/routes.py.

from .. import models
from ..calls import Call, Listing, model, paged_list, single_request
from ..encoding import parameters_of, path_of


class AlarmsMethods:
    """Methods for the routes of `service/features/alarms/routes.py` of the service."""

    @paged_list
    def alarms(
        self, spacecraft: str | None = None, *, run: str = "live", state: str = "active"
    ) -> Listing[models.Alarm]:
        """Alarms, newest first; by default those that are not cleared.

        - `spacecraft`: Only items of this spacecraft.
        - `run`: The run: `live` for the batches of pipelines, `*` for all runs.
        - `state`: `active`: all alarms that are not cleared.

        >>> [alarm.severity for alarm in client.alarms("XTE")]
        []
        """
        path = path_of("alarms")
        query = {"spacecraft": spacecraft, "run": run, "state": state}
        return Listing(models.Alarm, path, query)

    @single_request
    def alarm(self, id: str) -> Call[models.AlarmWithActions]:
        """One alarm with the history of its actions.

        - `id`: The `id` of an alarm.
        """
        path = path_of("alarms", id)
        return Call(model(models.AlarmWithActions), "GET", path)

    @single_request
    def acknowledge(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """Acknowledge an alarm; an alarm back in limits is cleared.

        - `id`: The `id` of an alarm.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        - `comment`: A comment.
        """
        path = path_of("alarms", id, "acknowledge")
        body = {"who": who, "comment": comment}
        return Call(model(models.AlarmWithActions), "POST", path, body=parameters_of(body))

    @single_request
    def comment(
        self, id: str, comment: str, *, who: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """Add a comment to an alarm.

        - `id`: The `id` of an alarm.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        """
        path = path_of("alarms", id, "comment")
        body = {"comment": comment, "who": who}
        return Call(model(models.AlarmWithActions), "POST", path, body=parameters_of(body))

    @single_request
    def shelve(
        self, id: str, minutes: int, *, who: str | None = None, comment: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """Shelve an alarm for some minutes; shelving ends by itself.

        - `id`: The `id` of an alarm.
        - `minutes`: At most a week.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        - `comment`: A comment.
        """
        path = path_of("alarms", id, "shelve")
        body = {"minutes": minutes, "who": who, "comment": comment}
        return Call(model(models.AlarmWithActions), "POST", path, body=parameters_of(body))

    @single_request
    def unshelve(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """End the shelving of an alarm.

        - `id`: The `id` of an alarm.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        - `comment`: A comment.
        """
        path = path_of("alarms", id, "unshelve")
        body = {"who": who, "comment": comment}
        return Call(model(models.AlarmWithActions), "POST", path, body=parameters_of(body))
