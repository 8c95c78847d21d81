"""Access control: tokens, callers by token or session with their rates, and the audit list.

A token is 32 random bytes after the prefix `acq_`.  The database stores its SHA-256 only: that many
random bits cannot be guessed, so no slower digest is needed.  Until the first token is made, access
on a loopback address is open.  Callers are cached for a second, so a revocation takes effect in
every process within a second.  The audit list records the author of every change; entries are only
added.
"""

import hashlib
import json
import re
import secrets
import threading
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, get_args

from sqlalchemy import Connection, delete, insert, select, update

from service.contract.access import AuditEntry, NewToken, Scope, Token, TokenState
from service.contract.base import Page
from service.errors import (
    BadInput,
    Busy,
    Conflict,
    Fault,
    Forbidden,
    NotFound,
    RateLimited,
    Unauthenticated,
    shown_value,
)
from service.missions.mission import Mission, mission_named
from service.storage.recording.ids import Ulids
from service.storage.recording.signatures import signed_in
from service.storage.sql.columns import Row
from service.storage.sql.tables import access_sessions, access_tokens, audit
from service.times import DAY_S, Utc, shifted, utc_now

MAX_BODY_KEPT = 4_000


@dataclass(frozen=True)
class Entry:
    """Entry of the audit list: author, action, object, request body, and status of the answer.

    It is stored in the transaction of the change itself: neither is stored without the other.
    """

    id: str
    moment: str
    who: str
    action: str
    about: str
    body: str | None = None
    status: int | None = None

    def row(self) -> Row:
        """Convert the audit entry to a database row, its body shortened."""
        return vars(self) | {"body": _kept(self.body)}

    def add_to(self, connection: Connection) -> None:
        """Insert the entry into the audit list."""
        connection.execute(insert(audit).values(self.row()))


def _kept(body: str | None) -> str | None:
    if body is None or len(body) <= MAX_BODY_KEPT:
        return body
    return body[: MAX_BODY_KEPT - 1] + "…"


READ_AT_ONCE = 500


def list_entries(
    connection: Connection,
    limit: int,
    cursor: str | None,
    *,
    person: str = "",
    action: str = "",
    about: str = "",
) -> Page[AuditEntry]:
    """List the entries of the audit list, newest first; a cursor is the id of the last one shown.

    `person` is the signature or the token's name; `action` and `about` are parts of the fields.
    """
    query = select(audit).order_by(audit.c.id.desc()).limit(READ_AT_ONCE)
    if action:
        query = query.where(audit.c.action.contains(action, autoescape=True))
    if about:
        query = query.where(audit.c.about.contains(about, autoescape=True))
    found: list[AuditEntry] = []
    while len(found) <= limit:
        older = query if cursor is None else query.where(audit.c.id < cursor)
        rows = [_entry(row) for row in connection.execute(older).mappings()]
        found += [each for each in rows if person in ("", each.person, each.who)]
        if len(rows) < READ_AT_ONCE:
            break
        cursor = rows[-1].id
    return Page(found[:limit], found[limit - 1].id if len(found) > limit else None)


def _entry(row: Any) -> AuditEntry:
    """Convert a stored audit entry, with the signature in its body, if it has one."""
    who, reason = signed_in(row["body"])
    return AuditEntry(**row, person=who or row["who"], reason=reason)


SCOPES: tuple[Scope, ...] = get_args(Scope)

PREFIX = "acq_"
SESSION_H = 12
"""Duration of a browser's session in hours."""
CLOCKS_APART_S = 300.0
"""Largest difference between the clocks of services on one database, in seconds."""
MAX_DAYS = 3660
DEFAULT_DAYS = 365
KNOWN_FOR_S = 1.0
MAX_KNOWN = 10_000
LEAST_BURST = 5.0

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._@+-]{0,63}", re.ASCII)


@dataclass(frozen=True)
class Caller:
    """Caller of a request, with its token's scopes, spacecraft and rate.

    `spacecraft` is None for all; `rate_per_s` is None for no limit.
    """

    name: str
    scopes: frozenset[str]
    spacecraft: frozenset[str] | None = None
    token_id: str | None = None
    rate_per_s: float | None = None

    def may_see(self, spacecraft: str) -> bool:
        """True if the caller has access to a spacecraft."""
        return self.spacecraft is None or spacecraft in self.spacecraft

    def require(self, spacecraft: str) -> None:
        """Raise `Forbidden` unless the caller has access to a spacecraft."""
        if self.spacecraft is not None and spacecraft not in self.spacecraft:
            theirs = ", ".join(sorted(self.spacecraft))
            raise Forbidden(f"{self.name} is bound to {theirs}, not to {spacecraft[:128]}")


OPEN_CALLER = Caller("local", frozenset(SCOPES))
"""Caller assigned to every request while access is open."""


def new_secret() -> str:
    """Generate a random secret for a token or a session."""
    return PREFIX + secrets.token_urlsafe(32)


def secret_digest(secret: str) -> str:
    """Digest of the secret of a token or a session, as stored in the database."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def add_token(
    connection: Connection,
    *,
    id: str,
    name: str,
    secret: str,
    scopes: Collection[str],
    spacecraft: Collection[str] | None,
    rate_per_s: float | None,
    created: str,
    expires: str,
) -> None:
    """Store a new token; its name signs the changes made with it.

    Raises `BadInput` for an invalid name or scope, `Conflict` for a name in use, also by a revoked
    token: the name stands in the audit list.
    """
    if not _NAME.fullmatch(name):
        message = "must be 1 to 64 letters, digits, spaces or . _ @ + -, a letter or digit first"
        raise BadInput(Fault("name", message, shown_value(name)))
    unknown = sorted(set(scopes) - set(SCOPES))
    if unknown or not scopes:
        message = f"must be some of {', '.join(SCOPES)}"
        raise BadInput(Fault("scope", message, shown_value(unknown)))
    if rate_per_s is not None and not 0.001 <= rate_per_s <= 1e6:
        message = "must be from 0.001 to 1000000 requests a second"
        raise BadInput(Fault("rate", message, shown_value(rate_per_s)))
    taken = select(access_tokens.c.id).where(access_tokens.c.name == name)
    if connection.execute(taken).first() is not None:
        raise Conflict(f"there is a token named {name!r} already, in use or revoked")
    connection.execute(
        insert(access_tokens).values(
            id=id,
            name=name,
            digest=secret_digest(secret),
            scopes=json.dumps([each for each in SCOPES if each in scopes]),
            spacecraft=None if spacecraft is None else json.dumps(sorted(set(spacecraft))),
            rate_per_s=rate_per_s,
            created=created,
            expires=expires,
            revoked=None,
        )
    )


def list_tokens(connection: Connection, now: str) -> list[Token]:
    """List all tokens without their digests, the oldest first, with their states at a time."""
    query = select(access_tokens).order_by(access_tokens.c.id)
    return [_token(row, now) for row in connection.execute(query).mappings()]


def read_token(connection: Connection, name: str, now: str) -> Token:
    """Read a token by name, without its digest; raises `NotFound`."""
    query = select(access_tokens).where(access_tokens.c.name == name)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"there is no token named {shown_value(name)}")
    return _token(row, now)


def _token(row: Any, now: str) -> Token:
    state: TokenState = "expired" if row["expires"] <= now else "good"
    return Token(
        name=row["name"],
        scopes=json.loads(row["scopes"]),
        spacecraft=row["spacecraft"] and json.loads(row["spacecraft"]),
        rate_per_s=row["rate_per_s"],
        created=row["created"],
        expires=row["expires"],
        revoked=row["revoked"],
        state="revoked" if row["revoked"] else state,
    )


def revoke_token(connection: Connection, name: str, moment: str) -> None:
    """Revoke a token and end its sessions; raises `NotFound`."""
    row = connection.execute(
        select(access_tokens.c.id, access_tokens.c.revoked).where(access_tokens.c.name == name)
    ).first()
    if row is None:
        raise NotFound(f"there is no token named {shown_value(name)}; see `acquire token list`")
    if row.revoked is None:
        connection.execute(
            update(access_tokens).where(access_tokens.c.id == row.id).values(revoked=moment)
        )
    connection.execute(delete(access_sessions).where(access_sessions.c.token_id == row.id))


def _caller(connection: Connection, kind: str, digest: str, now: Utc) -> Caller | None:
    """Look up the caller of a valid token or browser session; None if there is none."""
    condition, moment = access_tokens.c.digest == digest, now.text
    if kind == "session":
        # A session started by a clock far ahead, since corrected, would last too long.
        latest = shifted(now, SESSION_H * 3600 + CLOCKS_APART_S).text
        held = (
            select(access_sessions.c.token_id)
            .where(
                access_sessions.c.digest == digest,
                access_sessions.c.expires > moment,
                access_sessions.c.expires <= latest,
            )
            .scalar_subquery()
        )
        condition = access_tokens.c.id == held
    query = select(access_tokens).where(
        condition,
        access_tokens.c.revoked.is_(None),
        access_tokens.c.expires > moment,
    )
    row = connection.execute(query).mappings().first()
    if row is None:
        return None
    bound = row["spacecraft"]
    return Caller(
        row["name"],
        frozenset(json.loads(row["scopes"])),
        None if bound is None else frozenset(json.loads(bound)),
        row["id"],
        row["rate_per_s"],
    )


class Database(Protocol):
    """Interface to the database: reading, and changes with an entry in the audit list."""

    def reading(self) -> AbstractContextManager[Connection]:
        """Provide a connection with one snapshot of the database."""

    def change_audited(self, change: Callable[[Connection], Any], entry: Entry | None) -> Any:
        """Change the database in one transaction, with an entry in the audit list."""


class Tokens:
    """Service that creates, lists and revokes tokens; `entry` adds a change to the audit list."""

    def __init__(self, database: Database, missions: Mapping[str, Mission]) -> None:
        self._database, self._missions = database, missions
        self._ids = Ulids()

    def all(self) -> list[Token]:
        """List all tokens without their secrets, the oldest first."""
        with self._database.reading() as connection:
            return list_tokens(connection, utc_now().text)

    def add(
        self,
        name: str,
        scopes: Collection[str],
        *,
        spacecraft: Collection[str] | None = None,
        days: int = DEFAULT_DAYS,
        rate_per_s: float | None = None,
        entry: Entry | None = None,
    ) -> NewToken:
        """Create a token; only the return value holds its secret.

        Raises `BadInput` for invalid values and `Conflict` for a name that was used before.
        """
        for each in spacecraft or ():
            # A misspelt name would limit the token to nothing.
            mission_named(self._missions, each)
        secret, id, created = new_secret(), self._ids.new(), utc_now()

        def change(connection: Connection) -> Token:
            add_token(
                connection,
                id=id,
                name=name,
                secret=secret,
                scopes=scopes,
                spacecraft=spacecraft,
                rate_per_s=rate_per_s,
                created=created.text,
                expires=shifted(created, days * DAY_S).text,
            )
            return read_token(connection, name, created.text)

        made = self._database.change_audited(change, entry)
        return NewToken(
            token=secret, **{each: getattr(made, each) for each in Token.__struct_fields__}
        )

    def revoke(self, name: str, entry: Entry | None = None) -> Token:
        """Revoke a token and end its sessions; raises `NotFound`."""

        def change(connection: Connection) -> Token:
            moment = utc_now().text
            revoke_token(connection, name, moment)
            return read_token(connection, name, moment)

        revoked: Token = self._database.change_audited(change, entry)
        return revoked


Now = Callable[[], Utc]
Reading = Callable[[], AbstractContextManager[Connection]]
RunInTransaction = Callable[[Callable[[Connection], Any]], Any]


@dataclass
class _TokenBucket:
    """Token bucket of a rate limit: it fills with time, up to a burst."""

    left: float
    filled_s: float


class Access:
    """Service that identifies the callers of all requests."""

    def __init__(
        self, reading: Reading, change: RunInTransaction, loopback: bool, now: Now
    ) -> None:
        """Prepare access control; `reading` gives a connection, `change` runs and commits a change.

        `loopback` is True if the service listens on a loopback address only.
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
            # Tokens are never deleted: closed access stays closed.
            self._closed = self.has_tokens()
            self._open_until_s = clock_s + KNOWN_FOR_S
        return not self._closed

    @property
    def cached_is_open(self) -> bool | None:
        """True if access is known to be open, False if closed, None if not known without a read."""
        if self._closed or not self._loopback:
            return False
        return True if time.monotonic() < self._open_until_s else None

    def database_timed_out(self) -> None:
        """Make requests fail at once for a second, because the database did not answer in time."""
        self._out_of_reach_until_s = time.monotonic() + KNOWN_FOR_S

    def require_database(self) -> None:
        """Raise `Busy` where the database timed out within the last second."""
        if time.monotonic() < self._out_of_reach_until_s:
            raise Busy("the database does not answer", 5)

    def has_tokens(self) -> bool:
        """True if a token was ever made: from then on every request needs one."""
        with self._reading() as connection:
            return connection.execute(select(access_tokens.c.id).limit(1)).first() is not None

    def cached_caller(self, token: str | None, session: str | None) -> Caller | None:
        """Caller of a token or session from the cache; None if the database must be read."""
        clock_s = time.monotonic()
        if not self._closed and self._loopback:
            return OPEN_CALLER if clock_s < self._open_until_s else None
        kind, secret = ("session", session) if token is None else ("token", token)
        known = None if secret is None else self._known.get((kind, secret_digest(secret)))
        return known[0] if known is not None and clock_s < known[1] else None

    def last_known_caller(self, token: str | None, session: str | None) -> Caller | None:
        """Caller as of the last look-up, however long ago; None if never looked up.

        For requests that must be answered while the database is not.
        """
        if self.was_open:
            return OPEN_CALLER
        kind, secret = ("session", session) if token is None else ("token", token)
        known = None if secret is None else self._known.get((kind, secret_digest(secret)))
        return None if known is None else known[0]

    @property
    def was_open(self) -> bool:
        """True if access was open at the last check."""
        return self._loopback and not self._closed and self._open_until_s > 0.0

    def caller(self, token: str | None, session: str | None) -> Caller:
        """Caller of a bearer token or a session; raises `Unauthenticated`."""
        if self.is_open:
            return OPEN_CALLER
        for kind, secret in (("token", token), ("session", session)):
            if secret is not None:
                return self._holder(kind, secret_digest(secret))
        raise Unauthenticated("a token is needed: Authorization: Bearer acq_...")

    def look_up_again(self, token: str | None, session: str | None) -> Caller:
        """Look up the caller of a token or session again, without the cache."""
        with self._lock:
            self._open_until_s = 0.0
            for kind, secret in (("token", token), ("session", session)):
                if secret is not None:
                    self._known.pop((kind, secret_digest(secret)), None)
        return self.caller(token, session)

    def _holder(self, kind: str, digest: str) -> Caller:
        key, clock_s = (kind, digest), time.monotonic()
        known = self._known.get(key)
        if known is not None and clock_s < known[1]:
            return known[0]
        with self._reading() as connection:
            caller = _caller(connection, kind, digest, self._now())
        with self._lock:
            self._known.pop(key, None)
            if caller is None:
                raise Unauthenticated("the token is unknown, has expired or was revoked")
            if len(self._known) >= MAX_KNOWN:
                self._known.clear()
            self._known[key] = (caller, clock_s + KNOWN_FOR_S)
        return caller

    def count_request(self, caller: Caller, count: int = 1) -> None:
        """Count a request against the rate of its token; raises `RateLimited`.

        A request that counts as more than a burst is accepted when the full burst is available;
        later requests wait until the excess is made up for.
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
        """Clear the cache of callers, because tokens have changed."""
        with self._lock:
            self._known.clear()
            self._open_until_s = 0.0

    def sign_in(self, token: str) -> tuple[str, Caller]:
        """Start a browser's session; returns the secret for its cookie, and the caller."""
        caller = self._holder("token", secret_digest(token))
        if caller.token_id is None:
            raise Unauthenticated("access is open: signing in is not needed")
        token_id, secret, begun = caller.token_id, new_secret(), self._now()
        row = {
            "digest": secret_digest(secret),
            "token_id": token_id,
            "created": begun.text,
            "expires": shifted(begun, SESSION_H * 3600).text,
        }

        def begin(connection: Connection) -> None:
            # Delete expired sessions.
            expired = access_sessions.c.expires <= begun.text
            connection.execute(delete(access_sessions).where(expired))
            connection.execute(insert(access_sessions).values(row))

        self._change(begin)
        return secret, caller

    def sign_out(self, session: str) -> None:
        """End a browser's session."""
        digest = secret_digest(session)
        ended = delete(access_sessions).where(access_sessions.c.digest == digest)
        self._change(lambda connection: connection.execute(ended))
        with self._lock:
            self._known.pop(("session", digest), None)

    def entry(self, who: str, action: str, about: str, body: str | None, status: int) -> Entry:
        """Create an entry for the audit list."""
        return Entry(self._ids.new(), self._now().text, who, action, about, body, status)

    def add_entry(self, entry: Entry) -> None:
        """Store an audit entry without a change; returns after the commit."""
        self._change(entry.add_to)
