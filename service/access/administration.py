"""Tokens: made, listed and revoked through the API, the console and the command."""

from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from typing import Any, Protocol

from sqlalchemy import Connection

from service.access import tokens
from service.access.audit import Entry
from service.missions.mission import Mission, mission_named
from service.storage.models.access import NewToken, Token
from service.storage.recording.ids import Ulids
from service.times import DAY_S, shifted, utc_now

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
            return tokens.list_tokens(connection, utc_now().text)

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
        secret, id, created = tokens.new_secret(), self._ids.new(), utc_now()

        def change(connection: Connection) -> Token:
            tokens.add_token(
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
            return tokens.read_token(connection, name, created.text)

        made = self._database.change_audited(change, entry)
        return NewToken(
            token=secret, **{each: getattr(made, each) for each in Token.__struct_fields__}
        )

    def revoke(self, name: str, entry: Entry | None = None) -> Token:
        """End a token and the sessions begun with it; raises `NotFound`."""

        def change(connection: Connection) -> Token:
            moment = utc_now().text
            tokens.revoke_token(connection, name, moment)
            return tokens.read_token(connection, name, moment)

        revoked: Token = self._database.change_audited(change, entry)
        return revoked
