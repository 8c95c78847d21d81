"""Progress of the projections behind the record: set by the projector, awaited by readers."""

import threading
import time
from dataclasses import dataclass

from service.errors import Busy
from service.storage.readers import Readers
from service.storage.recording.writer import Writer
from service.storage.sql.statements import execute

POLL_S = 0.02
"""Seconds between a reader's checks of the position of another process's projector."""
WAIT_S = 1.0
"""Longest wait of a reader for the projections, in seconds."""
MOST_BEHIND = 20_000
"""Number of results not projected above which bulk loads, replays and reprocessing wait."""

_BEHIND = "SELECT count(*) FROM results WHERE seq > (SELECT seq FROM projector)"
_NEWEST_AND_POSITION = (
    "SELECT (SELECT coalesce(max(seq), 0) FROM results), (SELECT seq FROM projector)"
)


@dataclass(frozen=True)
class Lag:
    """Lag of the projections: number of unprojected results, and seconds since there were none."""

    results: int
    seconds: float


class Progress:
    """Position of the projector, for which readers can wait."""

    def __init__(
        self,
        readers: Readers,
        writer: Writer,
    ) -> None:
        self._database, self._writer = readers, writer
        self.is_shared = readers.file is None
        """True for a database that other processes may write and project as well."""
        self._changed = threading.Condition()
        self._is_followed = False
        """True while this process has a projector that readers wait for."""
        self.is_projecting = True
        """False while another process is known to project."""
        self._position = 0
        self._projected = -1
        """Number of the writer's commits when everything was last found projected."""
        self._readers = 0
        self._up_to_date_s = time.monotonic()

    # ---- for the projector -------------------------------------------------------------------

    def begin(self) -> None:
        """Start letting readers wait for the projector of this process."""
        self._is_followed = True

    def report(self, position: int, projected: int | None = None) -> None:
        """Set the projector's position in the record, and wake the waiting readers.

        `projected` is the writer's count of transactions, given if all of them are projected.
        """
        with self._changed:
            self._position = position
            if projected is not None:
                self._projected, self._up_to_date_s = projected, time.monotonic()
            self._changed.notify_all()

    def end(self) -> None:
        """Stop all waits of readers for the projector."""
        with self._changed:
            self._is_followed = False
            self._changed.notify_all()

    def wait_for_reader(self, seconds: float) -> None:
        """Wait, at most `seconds`, until a reader waits for the projector or no reader can wait."""
        with self._changed:
            self._changed.wait_for(lambda: self._readers or not self._is_followed, seconds)

    def is_behind(self) -> bool:
        """True if the writer has committed a transaction that is not projected."""
        return self._projected < self._writer.commits

    def places(self) -> tuple[int, int]:
        """Positions in the record of the newest result and of the projector."""
        asked_s = time.monotonic()
        with self._database.lookup() as connection:
            ((newest, position),) = execute(connection, _NEWEST_AND_POSITION)
        if position >= newest:
            self._up_to_date_s = max(self._up_to_date_s, asked_s)
        return newest, position

    # ---- for readers -------------------------------------------------------------------------

    def wait(self) -> float:
        """Wait, at most `WAIT_S`, until everything recorded so far is projected.

        Returns the lag of the projections in seconds: zero if there is none, or if this process has
        no projector.
        """
        if not self._is_followed:
            return 0.0
        if not self.is_shared and (not self.is_behind() or not self.is_projecting):
            return 0.0
        try:
            return self._waited()
        except Busy:
            # The record cannot be read now; the projections may still be readable.
            return time.monotonic() - self._up_to_date_s

    def _waited(self) -> float:
        commits = self._writer.commits
        newest, position = self.places()
        if position >= newest:
            return 0.0
        if not self.is_projecting:
            # Another process projects: poll its position.
            end_s = time.monotonic() + WAIT_S
            while time.monotonic() < end_s and self._is_followed:
                time.sleep(POLL_S)
                if self.places()[1] >= newest:
                    return 0.0
            return time.monotonic() - self._up_to_date_s

        def has_passed() -> bool:
            # The writer's count leaves out results of other processes.
            is_own = not self.is_shared and self._projected >= commits
            return self._position >= newest or is_own or not self._is_followed

        with self._changed:
            self._readers += 1
            self._changed.notify_all()
            is_passed = self._changed.wait_for(has_passed, WAIT_S)
            self._readers -= 1
            return 0.0 if is_passed else time.monotonic() - self._up_to_date_s

    def catch_up(self, most: int = 0) -> None:
        """Wait while more than `most` results remain to be projected."""
        while self._is_followed and (self.is_projecting or self.is_shared):
            if self._count_behind(most) <= most:
                return
            self.wait()

    def hold_back(self) -> None:
        """Delay a bulk write while too many results remain to be projected."""
        self.catch_up(MOST_BEHIND)

    def lag(self) -> Lag:
        """Present lag of the projections behind the record."""
        behind = self._count_behind(0)
        return Lag(behind, time.monotonic() - self._up_to_date_s if behind else 0.0)

    def _count_behind(self, most: int) -> int:
        """Number of results not projected yet; counted exactly only where it may exceed `most`."""
        if not self.is_shared and not self.is_behind():
            return 0
        newest, position = self.places()
        if newest - position <= most:
            return max(0, newest - position)
        with self._database.lookup() as connection:
            ((behind,),) = execute(connection, _BEHIND)
        return int(behind)
