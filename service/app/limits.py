"""Limits of quantities: those that hold, their history, and new ones."""

from service.access.audit import Entry
from service.alarms.limits import LimitSettings
from service.alarms.quantities import QuantityName, tracker_names
from service.alarms.subjects import limited_trackers
from service.app.context import Context
from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Mission, mission_named
from service.storage.models.alarms import Limit, LimitHistory
from service.storage.queries import limits
from service.times import utc_now


class Limits:
    """Reads and sets the limits of spacecraft."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def all(self, name: str, tracker: str | None = None) -> list[Limit]:
        """The limit of every quantity of a spacecraft, or of one of its trackers."""
        mission = mission_named(self._context.missions, name)
        own = _checked_tracker(mission, tracker)
        with self._context.reading() as connection:
            return limits.list_limits(connection, mission, own)

    def get(self, name: str, quantity: QuantityName, tracker: str | None = None) -> LimitHistory:
        """The limit of one quantity, the shipped limit, and the history of changes."""
        mission = mission_named(self._context.missions, name)
        own = _checked_tracker(mission, tracker, quantity)
        with self._context.reading() as connection:
            return limits.limit_history(connection, mission, quantity, own)

    def set(
        self,
        name: str,
        quantity: QuantityName,
        settings: LimitSettings | None,
        *,
        who: str,
        comment: str | None = None,
        entry: Entry | None = None,
        tracker: str | None = None,
    ) -> Limit:
        """Set a limit, which holds from the next batch on; None restores the shipped one.

        `entry` goes to the audit list with the change.
        """
        mission, moment = mission_named(self._context.missions, name), utc_now().text
        own = _checked_tracker(mission, tracker, quantity)
        return self._context.change_audited(
            lambda connection: limits.set_limit(
                connection,
                mission,
                quantity,
                settings,
                who=who,
                comment=comment,
                now=moment,
                tracker=own,
            ),
            entry,
        )


def _checked_tracker(
    mission: Mission, tracker: str | None, quantity: QuantityName | None = None
) -> str:
    """The tracker whose limits are meant; empty for those of the spacecraft.

    Raises `BadInput` for one that has none of its own, and for a quantity that no tracker has.
    """
    if tracker is None:
        return ""
    mission.tracker(tracker, "tracker")
    if tracker not in limited_trackers(mission):
        message = f"{mission.name} has one tracker; its limits are those of the spacecraft"
        raise BadBatch(Fault("tracker", message, shown_value(tracker)))
    if quantity is not None and quantity not in tracker_names():
        known = ", ".join(tracker_names())
        raise BadBatch(Fault("tracker", f"a tracker has {known} only", shown_value(quantity)))
    return tracker
