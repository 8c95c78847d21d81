"""Which process delivers: one of those that share a database.

The process that delivers raises a number every few seconds.  Another takes over where
the number has stood still for a while by its own clock, so the clocks of two machines
are never compared.
"""

from sqlalchemy import Connection, select, update

from service.storage.sql.access_tables import webhook_sender


def read_sender(connection: Connection) -> tuple[str | None, int]:
    """The process that delivers, None for none, and its number."""
    found = connection.execute(select(webhook_sender.c.holder, webhook_sender.c.beat)).one()
    return found.holder, found.beat


def hold_sender(connection: Connection, holder: str | None, beat: int) -> bool:
    """Deliver from now on, or go on to; False where the number is no longer `beat`.

    With None as holder no process delivers any more.
    """
    taken = connection.execute(
        update(webhook_sender)
        .where(webhook_sender.c.beat == beat)
        .values(holder=holder, beat=beat + 1)
    )
    return bool(taken.rowcount)
