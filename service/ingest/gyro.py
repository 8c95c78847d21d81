"""Gyro blocks on their way into the records: checked, looked up, and written once."""

from collections.abc import Callable, Mapping

from service.gyro.block import GyroBlock
from service.gyro.schema import require_rates_within
from service.ingest.solver_pool import mission_in_input
from service.missions.gyro import largest_rate_deg_per_s
from service.missions.mission import Mission
from service.storage.gyro import Recorded, find_block, record_block, row_of
from service.storage.recording.ids import Ulids
from service.storage.store import Store
from service.times import utc_now


class GyroIntake:
    """Records gyro blocks, each once, however often it is sent."""

    def __init__(self, missions: Mapping[str, Mission], store: Store) -> None:
        self._missions = missions
        self._store = store
        self._ids = Ulids()

    def begin(self, block: GyroBlock) -> Callable[[], Recorded]:
        """Queue a block for the writer; to call what it gives waits until it is recorded.

        Raises `BadBatch` for an unknown spacecraft and for a rate beyond the largest of its
        mission, `Busy` where too much is waiting.  Both raise `Conflict` where another body has
        its name, and `SampleTaken` where another block of the spacecraft and the run holds one
        of its times.
        """
        mission = mission_in_input(self._missions, block.spacecraft)
        require_rates_within(block, largest_rate_deg_per_s(mission.gyro))
        row = row_of(block, self._ids.new(), utc_now())
        # Looked up here as well: an error in the writer's transaction would make it begin anew.
        with self._store.reading_record() as connection:
            found = find_block(connection, block, row)
        if found is not None:
            recorded = Recorded(found, replayed=True)
            return lambda: recorded
        change = self._store.writer.change(lambda connection: record_block(connection, block, row))
        return change.result
