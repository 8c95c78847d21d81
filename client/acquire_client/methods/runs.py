"""Client methods: runs."""
# Written by `make client` from service/web/api/runs.py.

from .. import models
from ..calls import Call, items, model, single_request
from ..encoding import parameters_of, path_of


class RunsMethods:
    """Methods for the routes of `service/web/api/runs.py` of the service."""

    @single_request
    def replays(self) -> Call[list[models.Replay]]:
        """The latest replays and their progress, newest first.

        A token that is bound to spacecraft sees those into runs with batches of these alone.
        """
        path = path_of("replays")
        return Call(items(models.Replay), "GET", path)

    @single_request
    def cancel_replay(self, id: str) -> Call[models.Replay]:
        """Cancel a replay; the batches that it recorded stay.

        - `id`: The `id` of a replay.
        """
        path = path_of("replays", id)
        return Call(model(models.Replay), "DELETE", path)

    @single_request
    def runs(self) -> Call[list[models.Run]]:
        """All runs with batches; for a token bound to spacecraft, runs with their batches."""
        path = path_of("runs")
        return Call(items(models.Run), "GET", path)

    @single_request
    def watch_run(self, run: str, *, alarms: bool = True) -> Call[models.RunState]:
        """Switch the alarms of a run on or off; creates the run if it does not exist.

        - `run`: The run's name.
        - `alarms`: Whether its new batches can raise alarms. Live batches always can.
        """
        path = path_of("runs", run)
        body = {"alarms": alarms}
        return Call(model(models.RunState), "PUT", path, body=parameters_of(body))
