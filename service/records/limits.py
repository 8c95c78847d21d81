"""The limits of spacecraft as they are set: those that hold, and every one there was."""

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from sqlalchemy import Connection, bindparam, insert, select, update

from service.alarms.limits import LimitSettings, default_limits
from service.alarms.quantities import QUANTITIES, QuantityName
from service.missions.mission import Mission
from service.records import events
from service.records.draft import Row
from service.records.prepared import prepared
from service.records.tables import limits

Limits = Mapping[QuantityName, LimitSettings]

_SHIPPED: dict[str, Limits] = {}
# With every batch of a live spacecraft it is run anew.
_HOLDING = prepared(
    select(limits).where(
        limits.c.spacecraft == bindparam("of_spacecraft"), limits.c.until.is_(None)
    )
)


def limits_of(connection: Connection, mission: Mission) -> Limits:
    """The limits that hold for a spacecraft: its own in place of the shipped ones."""
    own = {
        row["quantity"]: _read(row["settings"])
        for row in _holding(connection, mission.name)
        if row["settings"] is not None
    }
    shipped = _SHIPPED.get(mission.digest)
    if shipped is None:
        # Asked for with every batch; a process meets few missions.
        shipped = _SHIPPED[mission.digest] = default_limits(mission)
    return {**shipped, **own}


@lru_cache(maxsize=256)
def _read(settings: str) -> LimitSettings:
    # Of one text always the same object: who knows a window to be in these limits knows it again.
    return LimitSettings.model_validate_json(settings)


def list_limits(connection: Connection, mission: Mission) -> list[Row]:
    """The limit of every quantity, with since when and who set it."""
    rows = {row["quantity"]: row for row in _holding(connection, mission.name)}
    return [
        limit_row(mission.name, name, settings, rows.get(name))
        for name, settings in default_limits(mission).items()
    ]


def limit_history(connection: Connection, mission: Mission, quantity: QuantityName) -> Row:
    """The limit that holds for a quantity, the shipped one, and all that was set, newest first."""
    shipped = default_limits(mission)[quantity]
    query = (
        select(limits)
        .where(limits.c.spacecraft == mission.name, limits.c.quantity == quantity)
        .order_by(limits.c.id.desc())
    )
    rows = [dict(row) for row in connection.execute(query).mappings()]
    latest = next((row for row in rows if row["until"] is None), None)
    return {
        "limit": limit_row(mission.name, quantity, shipped, latest),
        "default": shipped.model_dump(mode="json"),
        "history": [limit_row(mission.name, quantity, shipped, row) for row in rows],
    }


def set_limit(
    connection: Connection,
    mission: Mission,
    quantity: QuantityName,
    settings: LimitSettings | None,
    *,
    who: str,
    comment: str | None,
    now: str,
) -> Row:
    """Let a limit hold from now on; None: the shipped one again.  The one before is kept."""
    place = (limits.c.spacecraft == mission.name, limits.c.quantity == quantity)
    connection.execute(update(limits).where(*place, limits.c.until.is_(None)).values(until=now))
    row = {
        "spacecraft": mission.name,
        "quantity": quantity,
        "settings": None if settings is None else settings.model_dump_json(),
        "who": who,
        "comment": comment,
        "since": now,
        "until": None,
    }
    connection.execute(insert(limits), row)
    shown = limit_row(mission.name, quantity, default_limits(mission)[quantity], row)
    events.note(connection, "limit", shown, spacecraft=mission.name)
    return shown


def limit_row(
    spacecraft: str, quantity: QuantityName, shipped: LimitSettings, row: Any | None
) -> Row:
    """A limit as the interface shows it."""
    own = None if row is None else row["settings"]
    return {
        "spacecraft": spacecraft,
        "quantity": quantity,
        "unit": QUANTITIES[quantity].unit,
        "is_default": own is None,
        "since": row and row["since"],
        "who": row and row["who"],
        "comment": row and row["comment"],
        "settings": shipped.model_dump(mode="json") if own is None else json.loads(own),
    }


def _holding(connection: Connection, spacecraft: str) -> list[Row]:
    return _HOLDING.read(connection, {"of_spacecraft": spacecraft})
