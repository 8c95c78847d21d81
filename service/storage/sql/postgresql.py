"""A connection to PostgreSQL that waits for the server's answer no longer than it is told."""

from typing import TypeVar

import psycopg
from psycopg.abc import PQGen

RV = TypeVar("RV")

PING_S = 2.0
"""The timeout of the question whether a pooled connection is still there."""


class BoundedConnection(psycopg.Connection[tuple[object, ...]]):
    """A connection that is closed once an answer takes longer than `answer_s`.

    A server's own time-outs hold as long as it runs.  A server that is stopped, or a
    proxy before it, acknowledges every packet and never answers.
    """

    answer_s: float | None = None

    def wait(self, gen: PQGen[RV], interval: float = 0.1, timeout: float | None = None) -> RV:
        """Let a statement run to its end; raises `psycopg.OperationalError` where it takes long."""
        if timeout is None and self.answer_s is not None:
            # SQLAlchemy asks whether the connection is there outside of any transaction.
            timeout = min(PING_S, self.answer_s) if self.autocommit else self.answer_s
        try:
            return super().wait(gen, interval, timeout)
        except psycopg.errors._WaitTimeout as error:
            # The state of the server is unknown: the connection is not used again.
            self.pgconn.finish()
            raise psycopg.OperationalError(f"no answer within {timeout:g} s") from error
