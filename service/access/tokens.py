"""Access tokens: create, list, revoke, and look up by the secret that a client sends.

A token is 32 random bytes behind `acq_`.  The database keeps its SHA-256 alone:
nothing can be guessed of that many random bits, so no slower digest is needed.
"""

import hashlib
import json
import re
import secrets
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, get_args

from sqlalchemy import Connection, delete, insert, select, update

from service.access.audit import Entry
from service.errors import BadInput, Conflict, Fault, Forbidden, NotFound, shown_value
from service.missions.mission import Mission, mission_named
from service.storage.models.access import NewToken, Scope, Token, TokenState
from service.storage.recording.ids import Ulids
from service.storage.sql.access_tables import access_sessions, access_tokens
from service.times import DAY_S, shifted, utc_now

SCOPES: tuple[Scope, ...] = get_args(Scope)

PREFIX = "acq_"
SESSION_H = 12
"""How long a browser stays signed in, in hours."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._@+-]{0,63}", re.ASCII)


@dataclass(frozen=True)
class Caller:
    """A caller and what it may do.

    `spacecraft` None stands for every one.  `rate_per_s` None is no bound.
    """

    name: str
    scopes: frozenset[str]
    spacecraft: frozenset[str] | None = None
    token_id: str | None = None
    rate_per_s: float | None = None

    def may_see(self, spacecraft: str) -> bool:
        """True if the caller may see a spacecraft."""
        return self.spacecraft is None or spacecraft in self.spacecraft

    def require(self, spacecraft: str) -> None:
        """Raise `Forbidden` unless the caller may see a spacecraft."""
        if not self.may_see(spacecraft):
            theirs = ", ".join(sorted(self.spacecraft or ()))
            raise Forbidden(f"{self.name} is bound to {theirs}, not to {spacecraft[:128]}")


def new_secret() -> str:
    """A new random secret."""
    return PREFIX + secrets.token_urlsafe(32)


def secret_digest(secret: str) -> str:
    """The digest that is stored of a token or a session."""
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
    """Keep a new token under a name that signs what is done with it.

    Raises `BadInput` for a name or a scope that cannot be, `Conflict` for a
    name that is taken, also by a token that was revoked: the name stands in the
    audit list.
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
    """Every token without its digest, the oldest first; states are those at a time."""
    query = select(access_tokens).order_by(access_tokens.c.id)
    return [_token(row, now) for row in connection.execute(query).mappings()]


def read_token(connection: Connection, name: str, now: str) -> Token:
    """A token without its digest; raises `NotFound`."""
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
    """End a token and the sessions begun with it; raises `NotFound`."""
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


def any_token(connection: Connection) -> bool:
    """True if a token was ever made: from then on every request needs one."""
    return connection.execute(select(access_tokens.c.id).limit(1)).first() is not None


def holder_of(connection: Connection, digest: str, moment: str) -> Caller | None:
    """The caller of a token that is valid at `moment`; None for an invalid one."""
    return _caller(connection, access_tokens.c.digest == digest, moment)


def session_holder(connection: Connection, digest: str, moment: str) -> Caller | None:
    """The caller of a browser's session that is valid at `moment`; else None."""
    held = (
        select(access_sessions.c.token_id)
        .where(access_sessions.c.digest == digest, access_sessions.c.expires > moment)
        .scalar_subquery()
    )
    return _caller(connection, access_tokens.c.id == held, moment)


def add_session(
    connection: Connection, *, secret: str, token_id: str, created: str, expires: str
) -> None:
    """Begin a browser's session; expired ones are deleted."""
    connection.execute(delete(access_sessions).where(access_sessions.c.expires <= created))
    connection.execute(
        insert(access_sessions).values(
            digest=secret_digest(secret), token_id=token_id, created=created, expires=expires
        )
    )


def end_session(connection: Connection, digest: str) -> None:
    """End a browser's session, if there is one."""
    connection.execute(delete(access_sessions).where(access_sessions.c.digest == digest))


def _caller(connection: Connection, condition: object, moment: str) -> Caller | None:
    query = select(access_tokens).where(
        condition,  # type: ignore[arg-type]
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


MAX_DAYS = 3660
DEFAULT_DAYS = 365


class Database(Protocol):
    """Reads, and changes together with the audit list."""

    def reading(self) -> AbstractContextManager[Connection]:
        """A connection that sees one moment of the database."""

    def change_audited(self, change: Callable[[Connection], Any], entry: Entry | None) -> Any:
        """Change the database in one transaction, with an entry in the audit list."""


class Tokens:
    """Makes, lists and revokes tokens.  `entry` goes to the audit list with a change."""

    def __init__(self, database: Database, missions: Mapping[str, Mission]) -> None:
        self._database, self._missions = database, missions
        self._ids = Ulids()

    def all(self) -> list[Token]:
        """Every token without its secret, the oldest first."""
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
        """Make a token; its secret is in the answer alone.

        Raises `BadInput` for what cannot be and `Conflict` for a name that was used before.
        """
        for each in spacecraft or ():
            # A misspelt name would bind the token to nothing.
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
        """End a token and the sessions begun with it; raises `NotFound`."""

        def change(connection: Connection) -> Token:
            moment = utc_now().text
            revoke_token(connection, name, moment)
            return read_token(connection, name, moment)

        revoked: Token = self._database.change_audited(change, entry)
        return revoked
