"""Lock of the one service that projects, among those that share a PostgreSQL database.

It is an advisory lock of the session that writes.  PostgreSQL releases it when the session ends,
for any reason, and rolls back what the session had not committed: a service that has lost the lock
has lost its connection too.  Another session of the same pool does not hold the lock, so each
transaction of the projector first checks its session, which costs nothing.

The same session holds a lock for each replay and calibration in progress in its service, so that
other services see which ones run, and which ones were left by a service that ended.
"""

import threading
from collections.abc import Collection
from typing import Literal

from sqlalchemy import Connection

from service.errors import Busy
from service.storage.sql.statements import execute

# Key of two numbers; the second is a table's, so that each schema of a database has its own lock.
_TAKE = "SELECT pg_try_advisory_lock(1633906037, 'event_counter'::regclass::oid::int)"
# An id has 80 random bits: locks of different schemas do not collide.
_OF_WORK = "hashtextextended(%(id)s, 0)"
_HOLD = f"SELECT pg_advisory_lock_shared({_OF_WORK})"
_RELEASE = f"SELECT pg_advisory_unlock_shared({_OF_WORK})"
_IS_FREE = f"SELECT pg_try_advisory_xact_lock({_OF_WORK})"

Attempt = Literal["kept", "taken", "refused"]


class NotProjecting(Busy):
    """Error for work that only one service on a database does, raised in the others."""


class ProjectorLock:
    """Projector's lock of a shared database, held by the writer's session; for its thread."""

    def __init__(self) -> None:
        self._session: object | None = None
        """Database session that holds the projector's lock; None without the lock."""
        self.lost = threading.Event()
        """Event set when a transaction finds that its session does not hold the lock."""
        self.at_work: set[str] = set()
        """Ids of the replays and calibrations in progress in this service."""
        self._work_session: object | None = None
        self._held: set[str] = set()

    @property
    def is_held(self) -> bool:
        """True if this service projects, to its own knowledge, without asking the database."""
        return self._session is not None

    def require(self) -> None:
        """Raise `NotProjecting` unless this service holds the lock, without asking the database."""
        if self._session is None:
            raise NotProjecting("another service projects what is recorded")

    def require_in(self, connection: Connection) -> None:
        """Raise `NotProjecting` unless a transaction runs in the session that holds the lock."""
        if _session(connection) is not self._session:
            self._session = None
            self.lost.set()
            raise NotProjecting("the session that held the projector's lock has ended")

    def take(self, connection: Connection) -> Attempt:
        """Take the projector's lock for a session, unless this or another session has it.

        The locks of the replays and calibrations in progress are taken and released along with it.
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
    """Ids of the replays and calibrations, out of `ids`, that no session holds a lock for."""
    return {id for id in ids if execute(connection, _IS_FREE, {"id": id})[0][0]}


def _session(connection: Connection) -> object:
    return connection.connection.driver_connection
