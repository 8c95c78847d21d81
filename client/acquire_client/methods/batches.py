"""Client methods: batches."""
# Written by `make client` from service/web/api/batches.py.

from typing import Literal

from .. import models
from ..calls import Call, Listing, model, paged_list, single_request
from ..encoding import Batch, Time, path_of
from ..retrying import Repeat
from ..words import Outcome, Status


class BatchesMethods:
    """Methods for the routes of `service/web/api/batches.py` of the service."""

    @paged_list
    def batches(
        self,
        spacecraft: str | None = None,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        outcome: Outcome | None = None,
        status: Status | Literal["none"] | None = None,
        batch: str | None = None,
        adopted: bool = False,
    ) -> Listing[models.Summary]:
        """The current results of recorded batches, newest first by batch time.

        - `spacecraft`: Only items of this spacecraft.
        - `run`: The run: `live` for the batches of pipelines, `*` for all runs.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.
        - `outcome`: Only batches with at least one star of this outcome.
        - `status`: Only batches with a good attitude, with a suspect one, or with none.
        - `batch`: Only the batch with this batch id; needs `spacecraft`.
        - `adopted`: Only batches whose current result is an adopted what-if.

        >>> [found.batch for found in client.batches("XTE")]
        ['1996-010-0110']
        """
        path = path_of("batches")
        query = {
            "spacecraft": spacecraft,
            "run": run,
            "start": start,
            "end": end,
            "outcome": outcome,
            "status": status,
            "batch": batch,
            "adopted": adopted,
        }
        return Listing(models.Summary, path, query)

    @single_request
    def batch(self, id: str) -> Call[models.Result]:
        """One recorded result with its batch.

        - `id`: The `id` of a recorded result.
        """
        path = path_of("batches", id)
        return Call(model(models.Result), "GET", path)

    @single_request
    def submit_gyro(self, spacecraft: str, block: Batch) -> Call[models.GyroBlock]:
        """Record a block of gyro samples.

        The same block again is answered with 200 and `Replayed`. 409 if another body has its
        name, or if another block of the run holds one of its times.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `block`: The body of the request.

        >>> sorted(block)
        ['block', 'rates_rad_per_s', 'start', 'step_s']
        >>> recorded = client.submit_gyro("XTE", block)
        >>> recorded.end, recorded.samples
        ('1996-01-10T12:00:00.500Z', 2)
        """
        path = path_of("spacecraft", spacecraft, "gyro")
        return Call(model(models.GyroBlock), "POST", path, body=block, repeat=Repeat.ALWAYS)

    @paged_list
    def gyro(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Listing[models.GyroBlock]:
        """The gyro blocks that touch a period, without their samples, the earliest first.

        The samples of a period are the table `gyro`.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `run`: The run; `live` for the batches of pipelines.
        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.

        >>> recorded = client.submit_gyro("XTE", block)
        >>> [found.block for found in client.gyro("XTE")]
        ['g1']
        """
        path = path_of("spacecraft", spacecraft, "gyro")
        query = {"run": run, "start": start, "end": end}
        return Listing(models.GyroBlock, path, query)

    @single_request
    def gyro_samples(self, spacecraft: str, id: str) -> Call[models.GyroSamples]:
        """One gyro block with its samples.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `id`: The `id` of a recorded gyro block.

        >>> recorded = client.submit_gyro("XTE", block)
        >>> samples = client.gyro_samples("XTE", recorded.id)
        >>> samples.times_s, samples.rates_rad_per_s[1]
        ([0.0, 0.5], [0.0011, 0.0, 1e-05])
        """
        path = path_of("spacecraft", spacecraft, "gyro", id)
        return Call(model(models.GyroSamples), "GET", path)
