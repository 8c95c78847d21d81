"""The database that an archive belongs to: another one with the same batches could discard parts.

A database that was restored from an archive has the batches of the archive's own one.  What its
`acquire archive` takes for left over are parts that the other one needs.
"""

import hashlib
from pathlib import Path

import msgspec
from sqlalchemy import Connection, select

from service.errors import BadConfiguration
from service.storage.archive.folder import OWNER, Owner, read_owner, write_whole
from service.storage.sql.tables import mission_uses


def identity_of(connection: Connection) -> str:
    """A digest that two databases share only if one is a copy of the other.

    It is of the settings that the database was first served with, and of when that was, to the
    microsecond.  Raises `BadConfiguration` for a database that was never served.
    """
    c = mission_uses.c
    query = select(c.spacecraft, c.digest, c.since).order_by(c.id).limit(1)
    first = connection.execute(query).first()
    if first is None:
        raise BadConfiguration(
            "the database was never served, and so an archive cannot tell it from others: start "
            "the service with it once"
        )
    return hashlib.sha256("\0".join(map(str, first)).encode()).hexdigest()


def claim(connection: Connection, folder: Path) -> str:
    """Note a database as the owner of an archive that has none; returns its identity.

    The folder must be locked.  Raises `BadConfiguration` where another database owns it.
    """
    own, owner = identity_of(connection), read_owner(folder)
    if owner is None:
        content = msgspec.json.format(msgspec.json.encode(Owner(database=own)), indent=1)
        write_whole(folder / OWNER, content)
    elif owner.database != own:
        raise BadConfiguration(
            f"{folder}: the archive belongs to another database: name another folder; only if that "
            f"database is gone for good, delete {OWNER} in this one"
        )
    return own
