"""Calibrations of trackers: estimate them, read them, adopt them."""

from ..encoding import Time, parameters_of, path_of
from ..models import Calibration, CalibrationAdoption, CalibrationInForce, CalibrationSummary
from .connection import AsyncConnection
from .pages import AsyncItems


class AsyncCalibrations(AsyncConnection):
    """The part of the client that is about calibrations.

    `who` signs a change while access is open; with a token, its name does.
    """

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
    ) -> Calibration:
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
        return await self.post(Calibration, path_of("calibrations"), asked)

    def calibrations(self, spacecraft: str | None = None) -> AsyncItems[CalibrationSummary]:
        """Calibrations without covariances and residual maps, newest first.

        >>> [each.version async for each in client.calibrations("XTE")]
        []
        """
        query = {"spacecraft": spacecraft}
        return AsyncItems(self, CalibrationSummary, path_of("calibrations"), query)

    async def calibration(self, id: str) -> Calibration:
        """One calibration with all that was found; raises `NotFound`."""
        return await self.get(Calibration, path_of("calibrations", id))

    async def calibration_in_force(self, spacecraft: str) -> CalibrationInForce:
        """The calibration that new batches use, and what held when.

        >>> in_force = await client.calibration_in_force("XTE")
        >>> in_force.calibration, in_force.history
        (None, [])
        """
        path = path_of("spacecraft", spacecraft, "calibration")
        return await self.get(CalibrationInForce, path)

    async def adopt_calibration(
        self, id: str, *, who: str | None = None, note: str = ""
    ) -> CalibrationAdoption:
        """Let new batches be processed with a calibration; raises `WrongState`."""
        path = path_of("calibrations", id, "adopt")
        return await self.post(CalibrationAdoption, path, {"who": who, "note": note})

    async def revert_calibration(
        self, spacecraft: str, to: str | None = None, *, who: str | None = None, note: str = ""
    ) -> CalibrationAdoption:
        """Go back to the adoption of this id, or with None to the mission file."""
        path = path_of("spacecraft", spacecraft, "calibration", "revert")
        return await self.post(CalibrationAdoption, path, {"to": to, "who": who, "note": note})
