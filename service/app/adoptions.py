"""Adoption of calibrations by an operator, and the return to earlier ones."""

import logging
from collections.abc import Sequence

import msgspec
from sqlalchemy import Connection

from service.access import Entry
from service.app.context import Context
from service.contract.calibration import (
    CalibrationAdoption,
    CalibrationInForce,
    TrackerGeometry,
)
from service.errors import NotFound, WrongState, shown_value
from service.ingest.missions_in_force import MissionsInForce, geometry_digest, with_geometry
from service.missions.mission import Mission, load_missions, mission_named
from service.storage import adoptions
from service.storage.recording import events
from service.storage.recording.ids import Ulids
from service.storage.recording.results import register
from service.times import utc_now

log = logging.getLogger(__name__)

EVENT_FIELDS = ("id", "spacecraft", "adopted", "who", "note", "calibration", "version", "mission")
"""Fields of an adoption that its event contains; the others are long."""


class CalibrationAdoptions:
    """Service that adopts calibrations for spacecraft, and lists earlier adoptions."""

    def __init__(self, context: Context, in_force: MissionsInForce) -> None:
        self._context, self._in_force = context, in_force
        self._ids = Ulids()

    def in_force(self, spacecraft: str) -> CalibrationInForce:
        """Calibration that new batches of a spacecraft use, and all adoptions, newest first."""
        mission = self._context.mission(spacecraft)
        with self._context.reading() as connection:
            history = adoptions.list_adoptions(connection, spacecraft)
        latest = history[0] if history else None
        overridden = (
            latest is not None
            and latest.trackers is not None
            and not mission.retired
            and latest.file != geometry_digest(self.file_of(spacecraft))
        )
        return CalibrationInForce(
            spacecraft=spacecraft,
            mission=mission.digest,
            calibration=None if latest is None or overridden else latest.calibration,
            overridden=overridden,
            history=history,
        )

    def adopt(
        self,
        spacecraft: str,
        trackers: Sequence[TrackerGeometry],
        calibration: str,
        who: str,
        note: str = "",
        entry: Entry | None = None,
    ) -> CalibrationAdoption:
        """Adopt the tracker settings that a calibration gave, for new batches of a spacecraft.

        Raises `WrongState` where they are in force already, or the mission has other trackers.
        """
        file = self.file_of(spacecraft)
        if [each.name for each in trackers] != [each.name for each in file.trackers]:
            raise WrongState("the mission has other trackers by now: calibrate anew")
        return self._change(file, trackers, calibration, who, note, entry)

    def revert(
        self, spacecraft: str, to: str | None, who: str, note: str = "", entry: Entry | None = None
    ) -> CalibrationAdoption:
        """Return to an earlier adoption of a calibration, or with None to the mission file.

        Raises `NotFound` for another spacecraft's adoption, `WrongState` where it is in force.
        """
        file = self.file_of(spacecraft)
        if to is None:
            return self._change(file, None, None, who, note, entry)
        with self._context.reading() as connection:
            history = adoptions.list_adoptions(connection, spacecraft)
        for each in history:
            if each.id == to:
                return self._change(file, each.trackers, each.calibration, who, note, entry)
        raise NotFound(f"{spacecraft} has no adoption with the id {shown_value(to)}")

    def file_of(self, spacecraft: str) -> Mission:
        """Mission settings without adopted calibrations; the last known ones if no file is left."""
        return self._in_force.files.get(spacecraft) or self._context.mission(spacecraft)

    def changed_files(self) -> dict[str, str]:
        """Sentence on each mission file that has changed or gone; raises `BadConfiguration`."""
        settings = self._context.settings
        now = load_missions(*settings.mission_places, shipped=settings.ships_missions)
        found = {}
        for name, mission in self._in_force.files.items():
            if name not in now:
                found[name] = "The mission file is gone: the next start retires the spacecraft."
            elif now[name].digest != mission.digest:
                found[name] = "The mission file was changed: it takes effect at the next start."
        return found

    def _change(
        self,
        file: Mission,
        trackers: Sequence[TrackerGeometry] | None,
        calibration: str | None,
        who: str,
        note: str,
        entry: Entry | None,
    ) -> CalibrationAdoption:
        name, moment = file.name, utc_now().text
        mission = file if trackers is None else with_geometry(file, trackers)
        row = {
            "spacecraft": name,
            "adopted": moment,
            "who": who,
            "note": note,
            "calibration_id": calibration,
            "file_digest": geometry_digest(file),
            "mission_digest": mission.digest,
            "trackers": None if trackers is None else msgspec.json.encode(trackers).decode(),
        }
        settings = {
            "digest": mission.digest,
            "spacecraft": name,
            "settings": mission.model_dump_json(),
            "first_used": moment,
        }
        catalog = self._context.sky.catalog
        used = {"digest": catalog.digest, "name": catalog.name, "first_used": moment}

        def change(connection: Connection) -> CalibrationAdoption:
            register(connection, [settings], used)
            id = adoptions.begin_adoption(connection, self._ids.new())
            adoptions.add_adoption(connection, row | {"id": id})
            adopted = adoptions.list_adoptions(connection, name)[0]
            fields = {each: getattr(adopted, each) for each in EVENT_FIELDS}
            events.add_event(connection, "calibration", fields, spacecraft=name)
            return adopted

        self._in_force.follow()
        with self._in_force.replacing(mission):
            if mission_named(self._context.missions, name).digest == mission.digest:
                raise WrongState("these settings are in force already")
            # Results refer to the settings by digest, so record the settings before the first
            # result.
            return self._context.change_audited(change, entry)
