"""`acquire token`: in the database itself, also while a service uses it."""

import getpass
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict

from sqlalchemy import Connection

from service.access import audit, tokens
from service.cli.arguments import print_json
from service.errors import BadInput, Fault, shown_value
from service.missions.mission import load_missions, mission_named
from service.settings import Settings
from service.storage.recording.ids import Ulids
from service.storage.sql.database import Store
from service.storage.upkeep.expiries import SOON_DAYS
from service.times import DAY_S, shifted, utc_now

MAX_DAYS = 3660


def create(
    settings: Settings,
    name: str,
    scopes: Sequence[str],
    spacecraft: Sequence[str] | None,
    days: int,
    rate_per_s: float | None,
) -> int:
    """Make a token, print it and the way to use it."""
    if days > MAX_DAYS:
        raise BadInput(Fault("--days", f"must be at most {MAX_DAYS}", shown_value(days)))
    missions = load_missions(settings.missions)
    for each in spacecraft or ():
        # A misspelt name would bind the token to nothing.
        mission_named(missions, each)
    secret, ids, created = tokens.new_secret(), Ulids(), utc_now()
    expires = shifted(created, days * DAY_S)
    with _opened(settings) as store:

        def change(connection: Connection) -> None:
            tokens.add_token(
                connection,
                id=ids.new(),
                name=name,
                secret=secret,
                scopes=scopes,
                spacecraft=spacecraft,
                rate_per_s=rate_per_s,
                created=created.text,
                expires=expires.text,
            )
            _note(connection, ids, created.text, "token_create", name)

        store.writer.change(change).result()
    print(secret)
    print(f"\n{name} may {', '.join(scopes)}{_about(spacecraft)} until {expires.text[:10]}.")
    print("It is shown only now. Programs send it as `Authorization: Bearer acq_...`; commands")
    print("that talk to the service read it from ACQUIRE_TOKEN.")
    return 0


def show(settings: Settings, as_json: bool = False) -> int:
    """Print every token without its secret."""
    now = utc_now()
    with _opened(settings, create=False) as store, store.reading() as connection:
        rows = tokens.list_tokens(connection)
    states = [
        "revoked" if each.revoked else "expired" if each.expires <= now.text else "good"
        for each in rows
    ]
    if as_json:
        print_json(
            [asdict(row) | {"state": state} for row, state in zip(rows, states, strict=True)]
        )
        return 0
    if not rows:
        print("there are no tokens: access on this machine is open")
        return 0
    print(f"{'name':<24}{'scopes':<22}{'spacecraft':<18}{'until':<12}state")
    for row, stated in zip(rows, states, strict=True):
        state = stated
        about = "all" if row.spacecraft is None else ",".join(row.spacecraft)
        if state == "good" and row.expires <= shifted(now, SOON_DAYS * DAY_S).text:
            state = "expires soon"
        print(f"{row.name:<24}{','.join(row.scopes):<22}{about:<18}{row.expires[:10]:<12}{state}")
    return 0


def revoke(settings: Settings, name: str) -> int:
    """End a token."""
    ids, moment = Ulids(), utc_now().text
    with _opened(settings, create=False) as store:

        def change(connection: Connection) -> None:
            tokens.revoke_token(connection, name, moment)
            _note(connection, ids, moment, "token_revoke", name)

        store.writer.change(change).result()
    print(f"{name} is revoked; a running service heeds that within a second")
    return 0


def _about(spacecraft: Sequence[str] | None) -> str:
    return "" if spacecraft is None else f" about {', '.join(spacecraft)}"


def _note(connection: Connection, ids: Ulids, moment: str, action: str, name: str) -> None:
    who = f"command:{getpass.getuser()}"
    audit.add_entry(
        connection, id=ids.new(), moment=moment, who=who[:80], action=action, about=name
    )


@contextmanager
def _opened(settings: Settings, create: bool = True) -> Iterator[Store]:
    store = Store(settings.database, create=create)
    try:
        yield store
    finally:
        store.close()
