"""Alarms and calibrations: read them, and act on them.

`who` signs an action while access is open; with a token, its name does.
"""

from typing import Any

from .. import models
from ..encoding import Time, parameters_of, path_of
from .connection import AsyncConnection, AsyncItems


class AsyncAlarms(AsyncConnection):
    """The part of the client that is about alarms."""

    def alarms(
        self, spacecraft: str | None = None, *, run: str = "live", state: str = "active"
    ) -> AsyncItems[models.Alarm]:
        """Alarms, newest first; `state` active: all that are not cleared.

        >>> [alarm.severity async for alarm in client.alarms("XTE")]
        []
        """
        query = {"spacecraft": spacecraft, "run": run, "state": state}
        return AsyncItems(self, models.Alarm, path_of("alarms"), query)

    async def alarm(self, id: str) -> models.AlarmWithActions:
        """One alarm with its history; raises `NotFound`."""
        return await self.get(models.AlarmWithActions, path_of("alarms", id))

    async def acknowledge(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> models.AlarmWithActions:
        """Acknowledge an alarm, which clears it if the quantity is back in limits."""
        return await self._act(id, "acknowledge", {"who": who, "comment": comment})

    async def shelve(
        self, id: str, minutes: int, *, who: str | None = None, comment: str | None = None
    ) -> models.AlarmWithActions:
        """Silence an alarm for some minutes; it returns by itself."""
        return await self._act(id, "shelve", {"minutes": minutes, "who": who, "comment": comment})

    async def unshelve(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> models.AlarmWithActions:
        """Let a shelved alarm return now."""
        return await self._act(id, "unshelve", {"who": who, "comment": comment})

    async def comment(
        self, id: str, comment: str, *, who: str | None = None
    ) -> models.AlarmWithActions:
        """Add a comment to an alarm."""
        return await self._act(id, "comment", {"who": who, "comment": comment})

    async def _act(self, id: str, action: str, body: dict[str, Any]) -> models.AlarmWithActions:
        return await self.post(models.AlarmWithActions, path_of("alarms", id, action), body)


class AsyncCalibrations(AsyncConnection):
    """The part of the client that is about calibrations."""

    async def calibrate(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        degree: int | None = None,
        time_tag: bool = False,
        who: str | None = None,
    ) -> models.Calibration:
        """Begin a calibration from recorded batches; read it again until its `state` is done.

        Without a `degree`, the distortion gets the degree that fits held-out blocks of time best.
        """
        asked = parameters_of(
            {
                "spacecraft": spacecraft,
                "run": run,
                "start": start,
                "end": end,
                "degree": degree,
                "time_tag": time_tag,
                "who": who,
            }
        )
        return await self.post(models.Calibration, path_of("calibrations"), asked)

    def calibrations(self, spacecraft: str | None = None) -> AsyncItems[models.CalibrationSummary]:
        """Calibrations without covariances and residual maps, newest first.

        >>> [each.version async for each in client.calibrations("XTE")]
        []
        """
        query = {"spacecraft": spacecraft}
        return AsyncItems(self, models.CalibrationSummary, path_of("calibrations"), query)

    async def calibration(self, id: str) -> models.Calibration:
        """One calibration with all that was found; raises `NotFound`."""
        return await self.get(models.Calibration, path_of("calibrations", id))

    async def calibration_in_force(self, spacecraft: str) -> models.CalibrationInForce:
        """The calibration that new batches use, and what held when.

        >>> in_force = await client.calibration_in_force("XTE")
        >>> in_force.calibration, in_force.history
        (None, [])
        """
        path = path_of("spacecraft", spacecraft, "calibration")
        return await self.get(models.CalibrationInForce, path)

    async def adopt_calibration(
        self, id: str, *, who: str | None = None, note: str = ""
    ) -> models.CalibrationAdoption:
        """Let new batches be processed with a calibration; raises `WrongState`."""
        path = path_of("calibrations", id, "adopt")
        return await self.post(models.CalibrationAdoption, path, {"who": who, "note": note})

    async def revert_calibration(
        self, spacecraft: str, to: str | None = None, *, who: str | None = None, note: str = ""
    ) -> models.CalibrationAdoption:
        """Go back to the adoption of this id, or with None to the mission file."""
        path = path_of("spacecraft", spacecraft, "calibration", "revert")
        return await self.post(
            models.CalibrationAdoption, path, {"to": to, "who": who, "note": note}
        )
