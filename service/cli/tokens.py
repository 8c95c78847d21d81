"""`acquire token`: in the database itself, or through the service that writes to its file."""

import getpass
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any, Protocol
from urllib.parse import quote

import msgspec
from sqlalchemy import Connection

from service.access.audit import Entry
from service.access.tokens import MAX_DAYS, Tokens
from service.cli.arguments import print_json
from service.errors import (
    AcquisitionError,
    BadInput,
    Busy,
    Fault,
    Forbidden,
    Unauthenticated,
    shown_value,
)
from service.missions.mission import load_missions
from service.settings import Settings
from service.storage.models.access import NewToken, Token
from service.storage.recording.ids import Ulids
from service.storage.sql.database_file import is_written
from service.storage.sql.engines import database_file, database_url
from service.storage.store import Readers, Store
from service.storage.upkeep.expiries import SOON_DAYS
from service.times import DAY_S, shifted, utc_now

TIMEOUT_S = 30.0


class Refused(AcquisitionError):
    """The service refused the request; the message is its own."""


class TokenService(Protocol):
    """Makes and revokes tokens."""

    def add(
        self,
        name: str,
        scopes: Collection[str],
        *,
        spacecraft: Collection[str] | None,
        days: int,
        rate_per_s: float | None,
    ) -> NewToken:
        """Make a token."""

    def revoke(self, name: str) -> Token:
        """End a token."""


def create(
    settings: Settings,
    url: str,
    name: str,
    scopes: Collection[str],
    spacecraft: Collection[str] | None,
    days: int,
    rate_per_s: float | None,
) -> int:
    """Make a token and print it; the way to use it goes to the standard error output."""
    if days > MAX_DAYS:
        raise BadInput(Fault("--days", f"must be at most {MAX_DAYS}", shown_value(days)))
    with _opened(settings, url, create=True) as tokens:
        made = tokens.add(name, scopes, spacecraft=spacecraft, days=days, rate_per_s=rate_per_s)
    print(made.token)
    about = "" if spacecraft is None else f" about {', '.join(spacecraft)}"
    print(
        f"{name} may {', '.join(scopes)}{about} until {made.expires[:10]}.\n"
        "The token is shown only now. Programs send it as `Authorization: Bearer acq_...`; "
        "commands\nthat talk to the service read it from ACQUIRE_TOKEN.",
        file=sys.stderr,
    )
    return 0


def show(settings: Settings, as_json: bool = False) -> int:
    """Print every token without its secret."""
    readers = Readers(settings.database)
    try:
        rows = Tokens(_Direct(readers, None), {}).all()
    finally:
        readers.close()
    if as_json:
        print_json(msgspec.to_builtins(rows))
        return 0
    if not rows:
        print("there are no tokens: access on this machine is open")
        return 0
    soon = shifted(utc_now(), SOON_DAYS * DAY_S).text
    print(f"{'name':<24}{'scopes':<22}{'spacecraft':<18}{'until':<12}state")
    for row in rows:
        state = "expires soon" if row.state == "good" and row.expires <= soon else row.state
        about = "all" if row.spacecraft is None else ",".join(row.spacecraft)
        print(f"{row.name:<24}{','.join(row.scopes):<22}{about:<18}{row.expires[:10]:<12}{state}")
    return 0


def revoke(settings: Settings, url: str, name: str) -> int:
    """End a token."""
    with _opened(settings, url) as tokens:
        tokens.revoke(name)
    print(f"{name} is revoked; a running service heeds that within a second")
    return 0


@contextmanager
def _opened(settings: Settings, url: str, create: bool = False) -> Iterator[TokenService]:
    """The tokens of the database, or of the service that alone writes to its file."""
    file = database_file(database_url(settings.database))
    if file is not None and file.path.exists() and is_written(file):
        import httpx

        headers = {} if settings.token is None else {"Authorization": f"Bearer {settings.token}"}
        # The service may listen to this machine alone, where no proxy reaches it.
        with httpx.Client(
            base_url=url, timeout=TIMEOUT_S, trust_env=False, headers=headers
        ) as client:
            yield _OverHttp(client, url)
        return
    store = Store(settings.database, create=create)
    try:
        yield _InDatabase(store, settings)
    finally:
        store.close()


class _Direct:
    """The database for `Tokens`; changes are signed by the user of this machine."""

    def __init__(self, readers: Readers, store: Store | None) -> None:
        self.reading = readers.reading
        self._store = store

    def change_audited(self, change: Callable[[Connection], Any], entry: Entry | None) -> Any:
        """Change the database in one transaction, with an entry in the audit list."""
        assert self._store is not None

        def audited(connection: Connection) -> Any:
            changed = change(connection)
            if entry is not None:
                entry.add_to(connection)
            return changed

        return self._store.writer.change(audited).result()


class _InDatabase:
    def __init__(self, store: Store, settings: Settings) -> None:
        self._tokens = Tokens(_Direct(store, store), load_missions(settings.missions))

    def add(self, name: str, scopes: Collection[str], **more: Any) -> NewToken:
        return self._tokens.add(name, scopes, **more, entry=_entry("token_create", name))

    def revoke(self, name: str) -> Token:
        return self._tokens.revoke(name, _entry("token_revoke", name))


def _entry(action: str, name: str) -> Entry:
    who = f"command:{getpass.getuser()}"[:80]
    return Entry(Ulids().new(), utc_now().text, who, action, name)


class _OverHttp:
    def __init__(self, client: Any, url: str) -> None:
        self._client, self._url = client, url

    def add(self, name: str, scopes: Collection[str], **more: Any) -> NewToken:
        body = {"name": name, "scopes": list(scopes), **more}
        return msgspec.json.decode(self._request("POST", "", json=body), type=NewToken)

    def revoke(self, name: str) -> Token:
        return msgspec.json.decode(self._request("DELETE", f"/{quote(name, safe='')}"), type=Token)

    def _request(self, method: str, path: str, **arguments: Any) -> bytes:
        import httpx

        try:
            response = self._client.request(method, f"/api/v1/tokens{path}", **arguments)
        except httpx.HTTPError as error:
            raise Busy(
                f"a service writes to the database, but none answers at {self._url} ({error}): "
                "name its address with --url"
            ) from None
        if response.is_success:
            return bytes(response.content)
        try:
            detail = str(response.json()["detail"])
        except (ValueError, KeyError, TypeError):
            detail = f"HTTP {response.status_code}"
        if response.status_code in (401, 403):
            kind = Unauthenticated if response.status_code == 401 else Forbidden
            raise kind(
                f"{detail}; tokens are changed through the service at {self._url}: set "
                "ACQUIRE_TOKEN to a token with the scope operate that is bound to no spacecraft, "
                "or stop the service"
            )
        raise Refused(detail)
