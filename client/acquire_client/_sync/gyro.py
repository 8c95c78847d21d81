"""Gyro blocks: submit them, list them, read their samples."""

from ..encoding import Batch, Time, path_of
from ..models import GyroBlock, GyroSamples
from ..retrying import Repeat
from .connection import Connection
from .pages import Items


class Gyro(Connection):
    """The part of the client that is about gyro blocks."""

    def submit_gyro(self, spacecraft: str, block: Batch) -> GyroBlock:
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
        return self.post(GyroBlock, path, block, Repeat.ALWAYS)

    def gyro(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
    ) -> Items[GyroBlock]:
        """The blocks that touch a period, the earliest first; `end` is excluded.

        >>> recorded = client.submit_gyro("XTE", block)
        >>> [found.block for found in client.gyro("XTE")]
        ['g1']
        """
        query = {"run": run, "start": start, "end": end}
        return Items(self, GyroBlock, path_of("spacecraft", spacecraft, "gyro"), query)

    def gyro_samples(self, spacecraft: str, id: str) -> GyroSamples:
        """One block with its samples; raises `NotFound`.

        >>> recorded = client.submit_gyro("XTE", block)
        >>> samples = client.gyro_samples("XTE", recorded.id)
        >>> samples.times_s, samples.rates_rad_per_s[1]
        ([0.0, 0.5], [0.0011, 0.0, 1e-05])
        """
        return self.get(GyroSamples, path_of("spacecraft", spacecraft, "gyro", id))
