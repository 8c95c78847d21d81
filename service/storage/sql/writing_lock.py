"""The lock of the one service that writes to a PostgreSQL database.

It is an advisory lock of the session that writes.  PostgreSQL releases it when the session ends,
whatever ends it, and rolls back what the session had not committed: a service that has lost the
lock has lost its connection too, and cannot write.  Another session of the same pool does not
hold the lock, so each transaction begins with the question whose session it has, which costs
nothing.
"""

import threading
from typing import Literal

from sqlalchemy import Connection

from service.errors import Standby

# Two numbers, the second of which is that of a table: each schema of a database has its own lock.
_NAME = "1633906037, 'event_counter'::regclass::oid::int"
_TAKE = f"SELECT pg_try_advisory_lock({_NAME})"
_GIVE = f"SELECT pg_advisory_unlock({_NAME})"

Attempt = Literal["kept", "taken", "refused"]


class WritingLock:
    """Whether the session that writes holds the lock; used by one thread at a time."""

    def __init__(self) -> None:
        self._session: object | None = None
        """The driver's connection that holds the lock."""
        self._is_refused = True
        """False after the lock was held, until another session is known to have it."""
        self.lost = threading.Event()
        """Set where a transaction found that its session does not hold the lock."""

    def require(self) -> None:
        """Raise `Standby` unless the lock is held, as far as is known without asking."""
        if self._session is None:
            raise Standby(self._is_refused)

    def require_in(self, connection: Connection) -> None:
        """Raise `Standby` unless the session of a transaction is the one that holds the lock."""
        if self._session is None or _session(connection) is not self._session:
            self._session = None
            self.lost.set()
            raise Standby(self._is_refused)

    def take(self, connection: Connection) -> Attempt:
        """Take the lock for a session, unless that has it already or another session has."""
        session = _session(connection)
        if session is self._session:
            return "kept"
        taken = connection.exec_driver_sql(_TAKE).scalar_one()
        self._session = session if taken else None
        self._is_refused = not taken
        return "taken" if taken else "refused"

    def give(self, connection: Connection) -> None:
        """Leave the lock to another service, if this session has it."""
        if _session(connection) is self._session:
            self._session = None
            connection.exec_driver_sql(_GIVE)


def _session(connection: Connection) -> object:
    return connection.connection.driver_connection
