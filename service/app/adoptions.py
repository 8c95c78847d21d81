"""The calibration in force of each spacecraft: adopted and taken back by an operator.

An adopted calibration lies over the mission file: alignment and focal plane of every
tracker are those that were adopted, and all other settings the file's.  Where the file's
own alignments or focal planes have changed since, the file holds.
"""

import hashlib
import logging
import threading
from collections.abc import Callable, Mapping, Sequence

import msgspec
from sqlalchemy import Connection

from service.access import Entry
from service.app.context import Context
from service.contract.calibration import (
    CalibrationAdoption,
    CalibrationInForce,
    FocalPlane,
    TrackerGeometry,
    TrackerMagnitudes,
)
from service.errors import NotFound, WrongState, shown_value
from service.missions.mission import AS_MEASURED, Mission, Tracker, load_missions, mission_named
from service.storage import adoptions
from service.storage.recording import events
from service.storage.recording.ids import Ulids
from service.storage.recording.results import register
from service.times import utc_now

log = logging.getLogger(__name__)

EVENT_FIELDS = ("id", "spacecraft", "adopted", "who", "note", "calibration", "version", "mission")
"""The fields of a change's event; the others are long."""


def adopted_missions(
    connection: Connection, files: Mapping[str, Mission], leave: str | None = None
) -> dict[str, Mission]:
    """The missions of these files with an adopted calibration over them, but for `leave`."""
    found: dict[str, Mission] = {}
    for each in adoptions.latest_adoptions(connection):
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
        if adoptions.newest_adoption(connection) != self._loaded:
            self.load(self._leave)

    def load(self, leave: str | None = None) -> None:
        """Put what was adopted over the mission files, but for the spacecraft `leave`."""
        self._leave = leave
        with self._lock:
            before = dict(self._context.missions)
            with self._context.reading_record() as connection:
                self._loaded = adoptions.newest_adoption(connection)
                adopted = adopted_missions(connection, self._files, leave)
            self._context.missions.update(self._files | adopted)
            if self._context.missions != before:
                self._missions_changed()

    def in_force(self, spacecraft: str) -> CalibrationInForce:
        """The calibration that new batches use, and every change of it, newest first."""
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
        """Let new batches be processed with these trackers, which the calibration of this id gave.

        Raises `WrongState` where they are in force already, or the mission has others.
        """
        file = self.file_of(spacecraft)
        if [each.name for each in trackers] != [each.name for each in file.trackers]:
            raise WrongState("the mission has other trackers by now: calibrate anew")
        return self._change(file, trackers, calibration, who, note, entry)

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
            history = adoptions.list_adoptions(connection, spacecraft)
        for each in history:
            if each.id == to:
                return self._change(file, each.trackers, each.calibration, who, note, entry)
        raise NotFound(f"{spacecraft} has no adoption with the id {shown_value(to)}")

    def file_of(self, spacecraft: str) -> Mission:
        """The settings as the mission file has them, whatever was adopted; the last without one."""
        return self._files.get(spacecraft) or self._context.mission(spacecraft)

    def changed_files(self) -> dict[str, str]:
        """By spacecraft, what the next start would change; raises `BadConfiguration`."""
        settings = self._context.settings
        now = load_missions(*settings.mission_places, shipped=settings.ships_missions)
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
            id = adoptions.begin_adoption(connection, self._ids.new())
            adoptions.add_adoption(connection, row | {"id": id})
            adopted = adoptions.list_adoptions(connection, name)[0]
            fields = {each: getattr(adopted, each) for each in EVENT_FIELDS}
            events.add_event(connection, "calibration", fields, spacecraft=name)
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


def geometry_of(tracker: Tracker) -> TrackerGeometry:
    """Alignment, focal plane and magnitudes of a tracker."""
    plane = tracker.calibration
    return TrackerGeometry(
        name=tracker.name,
        x_axis_body=list(tracker.x_axis_body),
        y_axis_body=list(tracker.y_axis_body),
        z_axis_body=list(tracker.z_axis_body),
        calibration=FocalPlane(
            scale=plane.scale,
            h_terms=[list(each) for each in plane.h_terms],
            v_terms=[list(each) for each in plane.v_terms],
        ),
        magnitudes=TrackerMagnitudes(**tracker.magnitudes.model_dump()),
    )


def geometry_digest(mission: Mission) -> str:
    """`sha256:` of alignment, focal plane and magnitudes of all trackers, and of nothing else."""
    geometries = [msgspec.to_builtins(geometry_of(each)) for each in mission.trackers]
    for each, tracker in zip(geometries, mission.trackers, strict=True):
        # Adoptions of versions without magnitudes hold the digest of the rest.
        if tracker.magnitudes == AS_MEASURED:
            del each["magnitudes"]
    return "sha256:" + hashlib.sha256(msgspec.json.encode(geometries)).hexdigest()


def with_geometry(mission: Mission, trackers: Sequence[TrackerGeometry]) -> Mission:
    """The mission with the calibrations of these trackers; those not named stay as they are."""
    named = {each.name: each for each in trackers}
    changed = tuple(
        _with(each, named[each.name]) if each.name in named else each for each in mission.trackers
    )
    return mission.model_copy(update={"trackers": changed})


def _with(tracker: Tracker, geometry: TrackerGeometry) -> Tracker:
    fields = msgspec.to_builtins(geometry)
    if geometry.magnitudes is None:
        del fields["magnitudes"]
    settings = {
        **tracker.model_dump(exclude={"camera"}),
        **fields,
        "camera": tracker.camera,
    }
    return Tracker.model_validate(settings)
