"""Gyro blocks: recorded once, however often they are sent, and read back."""

from collections.abc import Callable

from service.app.context import Context, known_id
from service.gyro import GyroBlock, block_from_json, require_rates_within
from service.ingest.solver_pool import mission_in_input
from service.missions.mission import mission_named
from service.missions.motion import largest_rate_deg_per_s
from service.storage import gyro as blocks
from service.storage.models.base import Page
from service.storage.models.spacecraft import GyroBlockRow, GyroSamples
from service.storage.recording.ids import Ulids
from service.storage.recording.unsaved_result import LIVE
from service.times import Utc, utc_now


class Gyro:
    """Takes and reads gyro blocks."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._ids = Ulids()

    def submit(self, name: str, sent: bytes) -> blocks.Recorded:
        """Record the block of a JSON body; see `record`."""
        mission_named(self._context.missions, name)
        return self.record(block_from_json(sent, name))

    def record(self, block: GyroBlock) -> blocks.Recorded:
        """Record a block, and wait for that; a repeat of the same body gets the recorded one.

        See `begin` for what is refused.
        """
        return self.begin(block)()

    def begin(self, block: GyroBlock) -> Callable[[], blocks.Recorded]:
        """Queue a block for the writer; to call what it gives waits until it is recorded.

        Raises `BadBatch` for an unknown spacecraft and for a rate beyond the largest of its
        mission, `Busy` where too much is waiting.  Both raise `Conflict` where another body has
        its name, and `SampleTaken` where another block of the spacecraft and the run holds one
        of its times.
        """
        mission = mission_in_input(self._context.missions, block.spacecraft)
        require_rates_within(block, largest_rate_deg_per_s(mission.gyro))
        row = blocks.row_of(block, self._ids.new(), utc_now())
        store = self._context.store
        # Looked up here as well: an error in the writer's transaction would make it begin anew.
        with store.reading_record() as connection:
            found = blocks.find_block(connection, block, row)
        if found is not None:
            recorded = blocks.Recorded(found, replayed=True)
            return lambda: recorded
        return store.writer.change(
            lambda connection: blocks.record_block(connection, block, row)
        ).result

    def page(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[GyroBlockRow]:
        """The blocks of a period without their samples, the earliest first."""
        self._context.mission(name)
        selected = blocks.BlockFilter(name, run or LIVE, start, end)
        with self._context.reading() as connection:
            return blocks.list_blocks(connection, selected, limit=limit, cursor=cursor)

    def get(self, name: str, id: str) -> GyroSamples:
        """A block of a spacecraft with its samples."""
        with self._context.reading() as connection:
            return blocks.read_block(connection, name, known_id(id, "gyro block"))
