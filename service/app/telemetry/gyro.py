"""Gyro blocks: recorded once, however often they are sent, and read back."""

from service.app.context import Context, known_id
from service.gyro.block import GyroBlock
from service.gyro.schema import block_from_json
from service.ingest.gyro import GyroIntake
from service.missions.mission import mission_named
from service.storage.gyro import BlockFilter, Recorded, list_blocks, read_block
from service.storage.models.base import Page
from service.storage.models.gyro import GyroBlockRow, GyroSamples
from service.storage.recording.unsaved_result import LIVE
from service.times import Utc


class Gyro:
    """Takes and reads gyro blocks."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self.intake = GyroIntake(context.missions, context.store)

    def submit(self, name: str, sent: bytes) -> Recorded:
        """Record the block of a JSON body; see `record`."""
        mission_named(self._context.missions, name)
        return self.record(block_from_json(sent, name))

    def record(self, block: GyroBlock) -> Recorded:
        """Record a block, and wait for that; a repeat of the same body gets the recorded one.

        See `GyroIntake.begin` for what is refused.
        """
        return self.intake.begin(block)()

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
        selected = BlockFilter(name, run or LIVE, start, end)
        with self._context.reading() as connection:
            return list_blocks(connection, selected, limit=limit, cursor=cursor)

    def get(self, name: str, id: str) -> GyroSamples:
        """A block of a spacecraft with its samples."""
        with self._context.reading() as connection:
            return read_block(connection, name, known_id(id, "gyro block"))
