"""The lock of the one service that projects, among those that share a PostgreSQL database.

It is an advisory lock of the session that writes.  PostgreSQL releases it when the session ends,
whatever ends it, and rolls back what the session had not committed: a service that has lost the
lock has lost its connection too.  Another session of the same pool does not hold the lock, so
each transaction of the projector begins with the question whose session it has, which costs
nothing.

The same session holds a lock for each replay and calibration that its service is at work on, so
that others see which ones go on, and which ones a service left that has ended.
"""

import threading
from collections.abc import Collection
from typing import Literal

from sqlalchemy import Connection

from service.errors import Busy
from service.storage.sql.statements import execute

# Two numbers, the second of which is that of a table: each schema of a database has its own lock.
_TAKE = "SELECT pg_try_advisory_lock(1633906037, 'event_counter'::regclass::oid::int)"
# An id has 80 bits of chance: schemas do not come in each other's way.
_OF_WORK = "hashtextextended(%(id)s, 0)"
_HOLD = f"SELECT pg_advisory_lock_shared({_OF_WORK})"
_RELEASE = f"SELECT pg_advisory_unlock_shared({_OF_WORK})"
_IS_FREE = f"SELECT pg_try_advisory_xact_lock({_OF_WORK})"

Attempt = Literal["kept", "taken", "refused"]


class NotProjecting(Busy):
    """Refusal of work that only one service on a database does: another one does it."""


class ProjectorLock:
    """Knows if the session that writes holds the lock; used by the writer's thread."""

    def __init__(self) -> None:
        self._session: object | None = None
        """The driver's connection that holds the lock."""
        self.lost = threading.Event()
        """Set where a transaction found that its session does not hold the lock."""
        self.at_work: set[str] = set()
        """The ids of replays and calibrations that this service is at work on."""
        self._work_session: object | None = None
        self._held: set[str] = set()

    @property
    def is_held(self) -> bool:
        """True if this service projects, as far as is known without asking the database."""
        return self._session is not None

    def require(self) -> None:
        """Raise `NotProjecting` unless the lock is held, as far as is known without asking."""
        if self._session is None:
            raise NotProjecting("another service projects what is recorded")

    def require_in(self, connection: Connection) -> None:
        """Raise `NotProjecting` unless a transaction's session is the one that holds the lock."""
        if _session(connection) is not self._session:
            self._session = None
            self.lost.set()
            raise NotProjecting("the session that held the projector's lock has ended")

    def take(self, connection: Connection) -> Attempt:
        """Take the lock for a session, unless that has it already or another session has.

        The locks of the work at hand are taken and released along with it.
        """
        session = _session(connection)
        self._hold_work(connection, session)
        if session is self._session:
            return "kept"
        ((taken,),) = execute(connection, _TAKE)
        self._session = session if taken else None
        return "taken" if taken else "refused"

    def _hold_work(self, connection: Connection, session: object) -> None:
        if session is not self._work_session:
            self._work_session, self._held = session, set()
        wanted = set(self.at_work)
        for id in wanted - self._held:
            execute(connection, _HOLD, {"id": id})
        for id in self._held - wanted:
            execute(connection, _RELEASE, {"id": id})
        self._held = wanted


def left_behind(connection: Connection, ids: Collection[str]) -> set[str]:
    """The replays and calibrations that no session holds the lock of."""
    return {id for id in ids if execute(connection, _IS_FREE, {"id": id})[0][0]}


def _session(connection: Connection) -> object:
    return connection.connection.driver_connection
