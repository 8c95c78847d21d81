"""Token commands, in the database or through a service that writes to its SQLite file."""

import getpass
import sys
from argparse import Namespace
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from typing import Any, Protocol
from urllib.parse import quote

import msgspec
from sqlalchemy import Connection

from service import errors
from service.access import MAX_DAYS, Entry, Tokens
from service.cli.arguments import http_client, print_json, refusal_of, service_url, settings_of
from service.contract.access import NewToken, Token
from service.missions.mission import load_missions
from service.settings import Settings
from service.storage.readers import Readers
from service.storage.recording.ids import Ulids
from service.storage.sql.database_file import is_written
from service.storage.sql.engines import database_file, database_url
from service.storage.store import Store
from service.storage.upkeep.expiries import SOON_DAYS
from service.times import DAY_S, shifted, utc_now

TIMEOUT_S = 30.0


class Refused(errors.AcquisitionError):
    """Raised if the service refuses a request about tokens, with the message of the service."""


class TokenService(Protocol):
    """Interface to create and revoke access tokens."""

    def add(self, name: str, scopes: Collection[str], **more: Any) -> NewToken:
        """Create an access token; `more` are keywords of `Tokens.add`."""

    def revoke(self, name: str) -> Token:
        """Revoke an access token."""


def create_token(parsed: Namespace) -> int:
    """Create an access token and print it; instructions go to standard error."""
    days, spacecraft = parsed.days, parsed.spacecraft
    if days > MAX_DAYS:
        raise errors.BadInput(
            errors.Fault("--days", f"must be at most {MAX_DAYS}", errors.shown_value(days))
        )
    about = {"spacecraft": spacecraft, "days": days, "rate_per_s": parsed.rate}
    with opened_tokens(settings_of(parsed), service_url(parsed), create=True) as tokens:
        made = tokens.add(parsed.name, parsed.scope, **about)
    print(made.token)
    bound = "" if spacecraft is None else f" about {', '.join(spacecraft)}"
    print(
        f"{parsed.name} may {', '.join(parsed.scope)}{bound} until {made.expires[:10]}.\n"
        "The token is shown only now. Programs send it as `Authorization: Bearer acq_...`; "
        "commands\nthat talk to the service read it from ACQUIRE_TOKEN.",
        file=sys.stderr,
    )
    return 0


def print_tokens(settings: Settings, as_json: bool) -> int:
    """Print all access tokens without their secrets."""
    with closing(Readers(settings.database)) as readers:
        rows = Tokens(_Direct(readers, None), {}).all()
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


@contextmanager
def opened_tokens(settings: Settings, url: str, create: bool = False) -> Iterator[TokenService]:
    """Open the tokens of the database, or of a running service that owns its SQLite file."""
    file = database_file(database_url(settings.database))
    if file is not None and file.path.exists() and is_written(file):
        with http_client(settings, url, TIMEOUT_S) as client:
            yield _OverHttp(client, url)
        return
    with closing(Store(settings.database, create=create)) as store:
        yield _InDatabase(store, settings)


class _Direct:
    """Database access for `Tokens` by a command; changes are attributed to the local user."""

    def __init__(self, readers: Readers, store: Store | None) -> None:
        self.reading = readers.reading
        self._store = store

    def change_audited(self, change: Callable[[Connection], Any], entry: Entry | None) -> Any:
        """Change the database in one transaction, with an audit entry."""
        assert self._store is not None

        def audited(connection: Connection) -> Any:
            changed = change(connection)
            if entry is not None:
                entry.add_to(connection)
            return changed

        return self._store.writer.change(audited)


class _InDatabase:
    def __init__(self, store: Store, settings: Settings) -> None:
        missions = load_missions(*settings.mission_places, shipped=settings.ships_missions)
        self._tokens = Tokens(_Direct(store, store), missions)

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
            raise errors.Busy(
                f"a service writes to the database, but none answers at {self._url} ({error}): "
                "name its address with --url"
            ) from None
        if response.is_success:
            return bytes(response.content)
        detail = refusal_of(response)
        if response.status_code in (401, 403):
            kind = errors.Unauthenticated if response.status_code == 401 else errors.Forbidden
            raise kind(
                f"{detail}; tokens are changed through the service at {self._url}: set "
                "ACQUIRE_TOKEN to a token with the scope operate that is bound to no spacecraft, "
                "or stop the service"
            )
        raise Refused(detail)
