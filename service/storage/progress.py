"""How far the projections have come after the record: the projector tells, readers wait."""

import threading
import time
from dataclasses import dataclass

from service.errors import Busy
from service.storage.readers import Readers
from service.storage.recording.writer import Writer
from service.storage.sql.statements import execute

POLL_S = 0.02
"""The time between two looks of a reader for where another process projects."""
WAIT_S = 1.0
"""The longest wait of a reader for the projections."""
MOST_BEHIND = 20_000
"""Results; bulk loads, replays and reprocessing wait while there are more."""

_BEHIND = "SELECT count(*) FROM results WHERE seq > (SELECT seq FROM projector)"
_NEWEST_AND_POSITION = (
    "SELECT (SELECT coalesce(max(seq), 0) FROM results), (SELECT seq FROM projector)"
)


@dataclass(frozen=True)
class Lag:
    """How far the projections are behind the record: results, and seconds since they were not."""

    results: int
    seconds: float


class Progress:
    """Says how far the projector is, and lets readers wait for it."""

    def __init__(
        self,
        readers: Readers,
        writer: Writer,
    ) -> None:
        self._database, self._writer = readers, writer
        self.is_shared = readers.file is None
        """True for a database in which other processes record and project, too."""
        self._changed = threading.Condition()
        self._is_followed = False
        """True while this process has a projector, for which readers wait."""
        self.is_projecting = True
        """False where another process projects, as far as is known."""
        self._position = 0
        self._projected = -1
        """The writer's count of transactions up to which all is projected."""
        self._readers = 0
        self._up_to_date_s = time.monotonic()

    # ---- for the projector -------------------------------------------------------------------

    def begin(self) -> None:
        """Let readers wait for the projector of this process."""
        self._is_followed = True

    def report(self, position: int, projected: int | None = None) -> None:
        """Tell readers the projector's place in the record.

        `projected` is the writer's count of transactions where all of them are projected.
        """
        with self._changed:
            self._position = position
            if projected is not None:
                self._projected, self._up_to_date_s = projected, time.monotonic()
            self._changed.notify_all()

    def end(self) -> None:
        """Let no reader wait any more."""
        with self._changed:
            self._is_followed = False
            self._changed.notify_all()

    def wait_for_reader(self, seconds: float) -> None:
        """Return when a reader waits, or after so many seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._readers or not self._is_followed, seconds)

    def is_behind(self) -> bool:
        """True if the writer has committed a transaction that is not projected."""
        return self._projected < self._writer.commits

    def places(self) -> tuple[int, int]:
        """The places of the newest result and of the projector in the record."""
        asked_s = time.monotonic()
        with self._database.lookup() as connection:
            ((newest, position),) = execute(connection, _NEWEST_AND_POSITION)
        if position >= newest:
            self._up_to_date_s = max(self._up_to_date_s, asked_s)
        return newest, position

    # ---- for readers -------------------------------------------------------------------------

    def wait(self) -> float:
        """Return when all that is recorded now is projected, or after `WAIT_S`.

        The seconds that the projections are behind then; zero where they are not, or where this
        process has no projector.
        """
        if not self._is_followed:
            return 0.0
        if not self.is_shared and (not self.is_behind() or not self.is_projecting):
            return 0.0
        try:
            return self._waited()
        except Busy:
            # The database does not give the record now; the projections may still be readable.
            return time.monotonic() - self._up_to_date_s

    def _waited(self) -> float:
        commits = self._writer.commits
        newest, position = self.places()
        if position >= newest:
            return 0.0
        if not self.is_projecting:
            # Another process projects.
            end_s = time.monotonic() + WAIT_S
            while time.monotonic() < end_s and self._is_followed:
                time.sleep(POLL_S)
                if self.places()[1] >= newest:
                    return 0.0
            return time.monotonic() - self._up_to_date_s

        def has_passed() -> bool:
            # The writer's count says nothing of results of other processes.
            is_own = not self.is_shared and self._projected >= commits
            return self._position >= newest or is_own or not self._is_followed

        with self._changed:
            self._readers += 1
            self._changed.notify_all()
            is_passed = self._changed.wait_for(has_passed, WAIT_S)
            self._readers -= 1
            return 0.0 if is_passed else time.monotonic() - self._up_to_date_s

    def catch_up(self, most: int = 0) -> None:
        """Wait while more than so many results are to be projected."""
        while self._is_followed and (self.is_projecting or self.is_shared):
            if self._count_behind(most) <= most:
                return
            self.wait()

    def hold_back(self) -> None:
        """Wait while too much is to be projected; called before much is recorded at once."""
        self.catch_up(MOST_BEHIND)

    def lag(self) -> Lag:
        """How far behind the projections are."""
        behind = self._count_behind(0)
        return Lag(behind, time.monotonic() - self._up_to_date_s if behind else 0.0)

    def _count_behind(self, most: int) -> int:
        """How many results are to be projected; counted only if there may be more than so many."""
        if not self.is_shared and not self.is_behind():
            return 0
        newest, position = self.places()
        if newest - position <= most:
            return max(0, newest - position)
        with self._database.lookup() as connection:
            ((behind,),) = execute(connection, _BEHIND)
        return int(behind)
