"""Limits of quantities: those that hold, their history, and new ones."""

from service.access.audit import Entry
from service.alarms.limits import LimitSettings
from service.alarms.quantities import QuantityName
from service.app.context import Context
from service.missions.mission import mission_named
from service.storage.models.alarms import Limit, LimitHistory
from service.storage.queries import limits
from service.times import utc_now


class Limits:
    """Reads and sets the limits of spacecraft."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def all(self, name: str) -> list[Limit]:
        """The limit of every quantity of a spacecraft."""
        mission = mission_named(self._context.missions, name)
        with self._context.reading() as connection:
            return limits.list_limits(connection, mission)

    def get(self, name: str, quantity: QuantityName) -> LimitHistory:
        """The limit of one quantity, the shipped limit, and the history of changes."""
        mission = mission_named(self._context.missions, name)
        with self._context.reading() as connection:
            return limits.limit_history(connection, mission, quantity)

    def set(
        self,
        name: str,
        quantity: QuantityName,
        settings: LimitSettings | None,
        *,
        who: str,
        comment: str | None = None,
        entry: Entry | None = None,
    ) -> Limit:
        """Set a limit, which holds from the next batch on; None restores the shipped one.

        `entry` goes to the audit list with the change.
        """
        mission, moment = mission_named(self._context.missions, name), utc_now().text
        return self._context.change_audited(
            lambda connection: limits.set_limit(
                connection, mission, quantity, settings, who=who, comment=comment, now=moment
            ),
            entry,
        )
