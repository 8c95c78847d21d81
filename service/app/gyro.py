"""Gyro blocks: each recorded once, however often sent, and read back."""

from collections.abc import Sequence
from typing import Unpack

from sqlalchemy import Connection

from service.app.context import Context, PageOfPeriod, known_id
from service.contract.base import Page
from service.contract.spacecraft import GyroBlockRow, GyroSamples
from service.errors import AcquisitionError
from service.gyro.blocks import GyroBlock, block_from_json, require_rates_within
from service.ingest.solver_pool import mission_in_input
from service.missions.mission import mission_named
from service.missions.motion import largest_rate_deg_per_s
from service.storage import gyro as blocks
from service.storage.recording.ids import Ulids
from service.storage.sql.columns import Row
from service.times import utc_now


class Gyro:
    """Service that records and reads gyro blocks."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._ids = Ulids()

    def submit(self, name: str, sent: bytes) -> blocks.Recorded:
        """Record the gyro block in a JSON body; see `record`."""
        mission_named(self._context.missions, name)
        return self.record(block_from_json(sent, name))

    def record(self, block: GyroBlock) -> blocks.Recorded:
        """Record a gyro block; a repeat of the same body gets the recorded one.

        Raises `BadBatch` for an unknown spacecraft and for a rate beyond the largest of its
        mission, `Conflict` where another body has its name, and `SampleTaken` where another block
        of the spacecraft and the run holds one of its times.
        """
        (recorded,) = self.record_many([block])
        if isinstance(recorded, AcquisitionError):
            raise recorded
        return recorded

    def record_many(self, group: Sequence[GyroBlock]) -> list[blocks.Recorded | AcquisitionError]:
        """Record gyro blocks in one transaction; a refused one has its error in the list."""
        received = utc_now()
        found: dict[int, blocks.Recorded | AcquisitionError] = {}
        rows: dict[int, Row] = {}
        for place, block in enumerate(group):
            try:
                mission = mission_in_input(self._context.missions, block.spacecraft)
                require_rates_within(block, largest_rate_deg_per_s(mission.gyro))
            except AcquisitionError as error:
                found[place] = error
            else:
                rows[place] = blocks.row_of(block, self._ids.new(), received)

        def change(connection: Connection) -> dict[int, blocks.Recorded | AcquisitionError]:
            return {
                place: blocks.record_or_refuse(connection, group[place], row)
                for place, row in rows.items()
            }

        found |= self._context.change(change) if rows else {}
        return [found[place] for place in range(len(group))]

    def page(self, name: str, **asked: Unpack[PageOfPeriod]) -> Page[GyroBlockRow]:
        """Page of the gyro blocks in a period without their samples, the earliest first."""
        return self._context.page(blocks.list_blocks, blocks.BlockFilter, name, asked)

    def get(self, name: str, id: str) -> GyroSamples:
        """Read a gyro block of a spacecraft with its samples."""
        with self._context.reading() as connection:
            return blocks.read_block(connection, name, known_id(id, "gyro block"))
