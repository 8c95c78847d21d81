"""Alarms: read them, and act on them."""

from typing import Any

from ..encoding import path_of
from ..models import Alarm, AlarmWithActions
from .connection import AsyncConnection
from .pages import AsyncItems


class AsyncAlarms(AsyncConnection):
    """The part of the client that is about alarms.

    `who` signs an action while access is open; with a token, its name does.
    """

    def alarms(
        self, spacecraft: str | None = None, *, run: str = "live", state: str = "active"
    ) -> AsyncItems[Alarm]:
        """Alarms, newest first; `state` active: all that are not cleared.

        >>> [alarm.severity async for alarm in client.alarms("XTE")]
        []
        """
        query = {"spacecraft": spacecraft, "run": run, "state": state}
        return AsyncItems(self, Alarm, path_of("alarms"), query)

    async def alarm(self, id: str) -> AlarmWithActions:
        """One alarm with its history; raises `NotFound`."""
        return await self.get(AlarmWithActions, path_of("alarms", id))

    async def acknowledge(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> AlarmWithActions:
        """Acknowledge an alarm, which clears it if the quantity is back in limits."""
        return await self._act(id, "acknowledge", {"who": who, "comment": comment})

    async def shelve(
        self, id: str, minutes: int, *, who: str | None = None, comment: str | None = None
    ) -> AlarmWithActions:
        """Silence an alarm for some minutes; it returns by itself."""
        return await self._act(id, "shelve", {"minutes": minutes, "who": who, "comment": comment})

    async def unshelve(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> AlarmWithActions:
        """Let a shelved alarm return now."""
        return await self._act(id, "unshelve", {"who": who, "comment": comment})

    async def comment(self, id: str, comment: str, *, who: str | None = None) -> AlarmWithActions:
        """Add a comment to an alarm."""
        return await self._act(id, "comment", {"who": who, "comment": comment})

    async def _act(self, id: str, action: str, body: dict[str, Any]) -> AlarmWithActions:
        return await self.post(AlarmWithActions, path_of("alarms", id, action), body)
