"""The calibration in force of each spacecraft: adopted and taken back by an operator.

An adopted calibration lies over the mission file: alignment and focal plane of every
tracker are those that were adopted, and all other settings the file's.  Where the file's
own alignments or focal planes have changed since, the file holds.
"""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence

import msgspec
from sqlalchemy import Connection

from service.access.audit import Entry
from service.app.calibrations.findings import geometry_digest, with_geometry
from service.app.context import Context, known_id
from service.errors import NotFound, WrongState, shown_value
from service.missions.mission import Mission, load_missions, mission_named
from service.storage import calibrations
from service.storage.calibrations import (
    CalibrationAdoption,
    CalibrationInForce,
    TrackerGeometry,
)
from service.storage.recording import events
from service.storage.recording.ids import Ulids
from service.storage.recording.results import register
from service.times import utc_now

TOLD = ("id", "spacecraft", "adopted", "who", "note", "calibration", "version", "mission")
"""What the event of a change says of it; the rest is long."""

log = logging.getLogger(__name__)


def adopted_missions(
    connection: Connection, files: Mapping[str, Mission], leave: str | None = None
) -> dict[str, Mission]:
    """The missions of these files with an adopted calibration over them, but for `leave`."""
    found: dict[str, Mission] = {}
    for each in calibrations.latest_adoptions(connection):
        file = files.get(each.spacecraft)
        if file is None or each.spacecraft == leave or each.trackers is None:
            continue
        if each.file != geometry_digest(file):
            log.warning(
                "%s: the mission file was changed after calibration version %s was adopted; "
                "the file holds",
                each.spacecraft,
                each.version,
            )
            continue
        found[each.spacecraft] = with_geometry(file, each.trackers)
    return found


class CalibrationAdoptions:
    """Adopts calibrations, and says what held when.

    `context.missions` have what is in force; the settings of the files are kept here.
    """

    def __init__(self, context: Context, missions_changed: Callable[[], None]) -> None:
        """`missions_changed` is called after a mission of the context was replaced."""
        self._context = context
        self._files = dict(context.missions)
        self._missions_changed = missions_changed
        self._ids = Ulids()
        self._lock = threading.Lock()
        self._leave: str | None = None
        self._loaded: str | None = None
        """The newest adoption when they were loaded; empty where there was none."""

    def follow(self) -> None:
        """`load` again where another service has adopted one since."""
        with self._context.reading_record() as connection:
            self.follow_in(connection)

    def follow_in(self, connection: Connection) -> None:
        """`follow`, with a connection that sees the record as it is now.

        Each group of posts begins with this: whoever posts after an adoption was answered, by
        whichever service, is answered with the calibration that was adopted.
        """
        if calibrations.newest_adoption(connection) != self._loaded:
            self.load(self._leave)

    def load(self, leave: str | None = None) -> None:
        """Put what was adopted over the mission files, but for the spacecraft `leave`."""
        self._leave = leave
        with self._lock:
            before = dict(self._context.missions)
            with self._context.reading_record() as connection:
                self._loaded = calibrations.newest_adoption(connection)
                adopted = adopted_missions(connection, self._files, leave)
            self._context.missions.update(self._files | adopted)
            if self._context.missions != before:
                self._missions_changed()

    def in_force(self, spacecraft: str) -> CalibrationInForce:
        """The calibration that new batches use, and every change of it, newest first."""
        mission = self._context.mission(spacecraft)
        with self._context.reading() as connection:
            history = calibrations.list_adoptions(connection, spacecraft)
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
        self, id: str, who: str, note: str = "", entry: Entry | None = None
    ) -> CalibrationAdoption:
        """Let new batches be processed with a calibration.

        Raises `WrongState` for one that is not done, is in force already, or knows other
        trackers than the mission.
        """
        with self._context.reading() as connection:
            found = calibrations.read_calibration(connection, known_id(id, "calibration"))
        if found.result is None:
            raise WrongState(f"the calibration is {found.state}")
        names = [each.name for each in found.result.trackers]
        file = self.file_of(found.spacecraft)
        if names != [each.name for each in file.trackers]:
            raise WrongState("the mission has other trackers by now: calibrate anew")
        return self._change(file, found.result.trackers, found.id, who, note, entry)

    def revert(
        self, spacecraft: str, to: str | None, who: str, note: str = "", entry: Entry | None = None
    ) -> CalibrationAdoption:
        """Go back to an earlier adoption of this id, or with None to the mission file.

        Raises `NotFound` for another spacecraft's, `WrongState` where that is in force.
        """
        file = self.file_of(spacecraft)
        if to is None:
            return self._change(file, None, None, who, note, entry)
        with self._context.reading() as connection:
            history = calibrations.list_adoptions(connection, spacecraft)
        for each in history:
            if each.id == to:
                return self._change(file, each.trackers, each.calibration, who, note, entry)
        raise NotFound(f"{spacecraft} has no adoption with the id {shown_value(to)}")

    def file_of(self, spacecraft: str) -> Mission:
        """The settings as the mission file has them, whatever was adopted; the last without one."""
        return self._files.get(spacecraft) or self._context.mission(spacecraft)

    def changed_files(self) -> dict[str, str]:
        """By spacecraft, what the next start would change; raises `BadConfiguration`."""
        now = load_missions(self._context.settings.missions)
        found = {}
        for name, mission in self._files.items():
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
            id = calibrations.begin_adoption(connection, self._ids.new())
            calibrations.add_adoption(connection, row | {"id": id})
            adopted = calibrations.list_adoptions(connection, name)[0]
            told = {each: getattr(adopted, each) for each in TOLD}
            events.add_event(connection, "calibration", told, spacecraft=name)
            return adopted

        self.follow()
        with self._lock:
            if mission_named(self._context.missions, name).digest == mission.digest:
                raise WrongState("these settings are in force already")
            # Results name the settings by their digest, which is recorded before the first.
            adopted = self._context.change_audited(change, entry)
            self._context.missions[name] = mission
            self._missions_changed()
        return adopted
