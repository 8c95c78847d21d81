"""Alarms and calibrations: read them, and act on them.

`who` signs an action while access is open; with a token, its name does.
"""

from typing import Any

from .. import models
from ..encoding import Time, parameters_of, path_of
from .connection import Connection, Items


class Alarms(Connection):
    """The part of the client that is about alarms."""

    def alarms(
        self, spacecraft: str | None = None, *, run: str = "live", state: str = "active"
    ) -> Items[models.Alarm]:
        """Alarms, newest first; `state` active: all that are not cleared.

        >>> [alarm.severity for alarm in client.alarms("XTE")]
        []
        """
        query = {"spacecraft": spacecraft, "run": run, "state": state}
        return Items(self, models.Alarm, path_of("alarms"), query)

    def alarm(self, id: str) -> models.AlarmWithActions:
        """One alarm with its history; raises `NotFound`."""
        return self.get(models.AlarmWithActions, path_of("alarms", id))

    def acknowledge(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> models.AlarmWithActions:
        """Acknowledge an alarm, which clears it if the quantity is back in limits."""
        return self._act(id, "acknowledge", {"who": who, "comment": comment})

    def shelve(
        self, id: str, minutes: int, *, who: str | None = None, comment: str | None = None
    ) -> models.AlarmWithActions:
        """Silence an alarm for some minutes; it returns by itself."""
        return self._act(id, "shelve", {"minutes": minutes, "who": who, "comment": comment})

    def unshelve(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> models.AlarmWithActions:
        """Let a shelved alarm return now."""
        return self._act(id, "unshelve", {"who": who, "comment": comment})

    def comment(self, id: str, comment: str, *, who: str | None = None) -> models.AlarmWithActions:
        """Add a comment to an alarm."""
        return self._act(id, "comment", {"who": who, "comment": comment})

    def _act(self, id: str, action: str, body: dict[str, Any]) -> models.AlarmWithActions:
        return self.post(models.AlarmWithActions, path_of("alarms", id, action), body)


class Calibrations(Connection):
    """The part of the client that is about calibrations."""

    def calibrate(
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
        return self.post(models.Calibration, path_of("calibrations"), asked)

    def calibrations(self, spacecraft: str | None = None) -> Items[models.CalibrationSummary]:
        """Calibrations without covariances and residual maps, newest first.

        >>> [each.version for each in client.calibrations("XTE")]
        []
        """
        query = {"spacecraft": spacecraft}
        return Items(self, models.CalibrationSummary, path_of("calibrations"), query)

    def calibration(self, id: str) -> models.Calibration:
        """One calibration with all that was found; raises `NotFound`."""
        return self.get(models.Calibration, path_of("calibrations", id))

    def calibration_in_force(self, spacecraft: str) -> models.CalibrationInForce:
        """The calibration that new batches use, and what held when.

        >>> in_force = client.calibration_in_force("XTE")
        >>> in_force.calibration, in_force.history
        (None, [])
        """
        path = path_of("spacecraft", spacecraft, "calibration")
        return self.get(models.CalibrationInForce, path)

    def adopt_calibration(
        self, id: str, *, who: str | None = None, note: str = ""
    ) -> models.CalibrationAdoption:
        """Let new batches be processed with a calibration; raises `WrongState`."""
        path = path_of("calibrations", id, "adopt")
        return self.post(models.CalibrationAdoption, path, {"who": who, "note": note})

    def revert_calibration(
        self, spacecraft: str, to: str | None = None, *, who: str | None = None, note: str = ""
    ) -> models.CalibrationAdoption:
        """Go back to the adoption of this id, or with None to the mission file."""
        path = path_of("spacecraft", spacecraft, "calibration", "revert")
        return self.post(models.CalibrationAdoption, path, {"to": to, "who": who, "note": note})
