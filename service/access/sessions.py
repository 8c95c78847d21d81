"""Callers by token or session, their request rates, and their entries in the audit list.

Until the first token is made, access on a loopback address is open.  Callers are
cached for a second, so a revocation takes effect in every process within a second.
"""

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import Connection

from service.access import audit, tokens
from service.access.tokens import SCOPES, Caller
from service.errors import Busy, RateLimited, Unauthenticated
from service.storage.recording.ids import Ulids
from service.times import Utc, shifted

OPEN_CALLER = Caller("local", frozenset(SCOPES))
"""The caller of every request while access is open."""

KNOWN_FOR_S = 1.0
MAX_KNOWN = 10_000
LEAST_BURST = 5.0

Now = Callable[[], Utc]
Reading = Callable[[], AbstractContextManager[Connection]]
RunInTransaction = Callable[[Callable[[Connection], Any]], Any]


@dataclass
class _TokenBucket:
    """The token bucket of a rate limit: it fills with time, up to a burst."""

    left: float
    filled_s: float


class Access:
    """Identifies callers; the one place that does."""

    def __init__(
        self, reading: Reading, change: RunInTransaction, loopback: bool, now: Now
    ) -> None:
        """`reading` gives a connection; `change` runs a change and waits for its commit.

        `loopback`: whether the service listens on a loopback address only.
        """
        self._reading, self._change = reading, change
        self._loopback = loopback
        self._now = now
        self._ids = Ulids()
        self._lock = threading.Lock()
        self._known: dict[tuple[str, str], tuple[Caller, float]] = {}
        self._open_until_s = 0.0
        self._out_of_reach_until_s = 0.0
        self._closed = False
        self._buckets: dict[str, _TokenBucket] = {}

    @property
    def is_open(self) -> bool:
        """True if no token is required: on loopback, until the first one is made."""
        if self._closed or not self._loopback:
            return False
        clock_s = time.monotonic()
        if clock_s >= self._open_until_s:
            # Rows of tokens are never deleted: closed access stays closed.
            self._closed = self.has_tokens()
            self._open_until_s = clock_s + KNOWN_FOR_S
        return not self._closed

    @property
    def cached_is_open(self) -> bool | None:
        """`is_open` where it is known without reading the database; else None."""
        if self._closed or not self._loopback:
            return False
        return True if time.monotonic() < self._open_until_s else None

    def database_timed_out(self) -> None:
        """Let requests fail at once for a second, because the database did not answer in time."""
        self._out_of_reach_until_s = time.monotonic() + KNOWN_FOR_S

    def require_database(self) -> None:
        """Raise `Busy` where the database timed out within the last second."""
        if time.monotonic() < self._out_of_reach_until_s:
            raise Busy("the database does not answer", 5)

    def has_tokens(self) -> bool:
        """True if a token was ever made."""
        with self._reading() as connection:
            return tokens.any_token(connection)

    def cached_caller(self, token: str | None, session: str | None) -> Caller | None:
        """The result of `caller` where it is known without reading the database; else None."""
        clock_s = time.monotonic()
        if not self._closed and self._loopback:
            return OPEN_CALLER if clock_s < self._open_until_s else None
        kind, secret = ("session", session) if token is None else ("token", token)
        known = None if secret is None else self._known.get((kind, tokens.secret_digest(secret)))
        return known[0] if known is not None and clock_s < known[1] else None

    def last_known_caller(self, token: str | None, session: str | None) -> Caller | None:
        """The caller as it was at the last look-up, however long ago; None: never looked up.

        For what must answer while the database does not.
        """
        if self.was_open:
            return OPEN_CALLER
        kind, secret = ("session", session) if token is None else ("token", token)
        known = None if secret is None else self._known.get((kind, tokens.secret_digest(secret)))
        return None if known is None else known[0]

    @property
    def was_open(self) -> bool:
        """True if access was open when that was last asked."""
        return self._loopback and not self._closed and self._open_until_s > 0.0

    def caller(self, token: str | None, session: str | None) -> Caller:
        """The caller of a bearer token or a session; raises `Unauthenticated`."""
        if self.is_open:
            return OPEN_CALLER
        for kind, secret in (("token", token), ("session", session)):
            if secret is not None:
                return self._holder(kind, tokens.secret_digest(secret))
        raise Unauthenticated("a token is needed: Authorization: Bearer acq_...")

    def look_up_again(self, token: str | None, session: str | None) -> Caller:
        """`caller` without the cache."""
        with self._lock:
            self._open_until_s = 0.0
            for kind, secret in (("token", token), ("session", session)):
                if secret is not None:
                    self._known.pop((kind, tokens.secret_digest(secret)), None)
        return self.caller(token, session)

    def _holder(self, kind: str, digest: str) -> Caller:
        key, clock_s = (kind, digest), time.monotonic()
        known = self._known.get(key)
        if known is not None and clock_s < known[1]:
            return known[0]
        look_up = tokens.holder_of if kind == "token" else tokens.session_holder
        with self._reading() as connection:
            caller = look_up(connection, digest, self._now().text)
        with self._lock:
            self._known.pop(key, None)
            if caller is None:
                raise Unauthenticated("the token is unknown, has expired or was revoked")
            if len(self._known) >= MAX_KNOWN:
                self._known.clear()
            self._known[key] = (caller, clock_s + KNOWN_FOR_S)
        return caller

    def count_request(self, caller: Caller, count: int = 1) -> None:
        """Count a request against its token's rate; raises `RateLimited`.

        A request that counts as more than a burst is let through when the burst is there;
        requests after it wait until what it took beyond that is made up for.
        """
        rate = caller.rate_per_s
        if rate is None or caller.token_id is None or count < 1:
            return
        clock_s, burst = time.monotonic(), max(rate, LEAST_BURST)
        with self._lock:
            bucket = self._buckets.setdefault(caller.token_id, _TokenBucket(burst, clock_s))
            bucket.left = min(burst, bucket.left + rate * (clock_s - bucket.filled_s))
            bucket.filled_s = clock_s
            needed = max(1.0, min(count, burst - 1))
            if bucket.left < needed:
                wait_s = max(1, round((needed - bucket.left) / rate + 0.5))
                raise RateLimited(f"{caller.name} may send {rate:g} requests per second", wait_s)
            bucket.left -= count

    def forget(self) -> None:
        """Look callers up again from now on, because tokens have changed."""
        with self._lock:
            self._known.clear()
            self._open_until_s = 0.0

    def sign_in(self, token: str) -> tuple[str, Caller]:
        """Begin a browser's session; returns the secret for its cookie, and the caller."""
        caller = self._holder("token", tokens.secret_digest(token))
        if caller.token_id is None:
            raise Unauthenticated("access is open: signing in is not needed")
        token_id, secret, begun = caller.token_id, tokens.new_secret(), self._now()
        expires = shifted(begun, tokens.SESSION_H * 3600)
        self._change(
            partial(
                tokens.add_session,
                secret=secret,
                token_id=token_id,
                created=begun.text,
                expires=expires.text,
            )
        )
        return secret, caller

    def sign_out(self, session: str) -> None:
        """End a browser's session."""
        digest = tokens.secret_digest(session)
        self._change(partial(tokens.end_session, digest=digest))
        with self._lock:
            self._known.pop(("session", digest), None)

    def entry(
        self, who: str, action: str, about: str, body: str | None, status: int
    ) -> audit.Entry:
        """A new entry for the audit list."""
        return audit.Entry(self._ids.new(), self._now().text, who, action, about, body, status)

    def add_entry(self, entry: audit.Entry) -> None:
        """Store an entry without a change; returns after the commit."""
        self._change(entry.add_to)
