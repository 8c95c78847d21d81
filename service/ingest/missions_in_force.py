"""Missions in force: those of the mission files, with adopted calibrations applied.

An adopted calibration replaces the alignment and focal plane of every tracker; all other settings
are the file's.  Where the file's own alignments or focal planes have changed since the adoption,
the file takes precedence.  Several services on a database follow adoptions through any of them.
"""

import hashlib
import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import msgspec
from sqlalchemy import Connection

from service.contract.calibration import FocalPlane, TrackerGeometry, TrackerMagnitudes
from service.missions.mission import AS_MEASURED, Mission, Tracker
from service.storage.adoptions import latest_adoptions, newest_adoption
from service.storage.readers import Readers

log = logging.getLogger(__name__)


class MissionsInForce:
    """Mapping of missions that follows the calibrations adopted by operators.

    `missions` is changed in place: every holder of the mapping uses the missions in force.
    """

    def __init__(self, missions: dict[str, Mission], readers: Readers) -> None:
        """Start with `missions` as read from the mission files."""
        self.missions = missions
        self.files: Mapping[str, Mission] = dict(missions)
        """Missions as the mission files have them, by name."""
        self._readers = readers
        self._lock = threading.Lock()
        self._leave: str | None = None
        self._loaded: str | None = None
        """Id of the newest adoption at the last load; empty if there was none."""
        self._when_changed: list[Callable[[], None]] = []

    def when_changed(self, call: Callable[[], None]) -> None:
        """Register a function to call after each replacement of a mission."""
        self._when_changed.append(call)

    def follow(self) -> None:
        """Load the adopted calibrations again if the newest adoption is another one than loaded."""
        with self._readers.reading_record() as connection:
            self.follow_in(connection)

    def follow_in(self, connection: Connection) -> None:
        """Load the adopted calibrations again if they changed, through a given connection.

        Each group of posts begins here: a client that posts after any service has confirmed an
        adoption gets an answer with the adopted calibration.
        """
        if newest_adoption(connection) != self._loaded:
            self.load(self._leave)

    def adopted_names(self) -> list[str]:
        """Names of the spacecraft with an adopted calibration in force."""
        return [name for name, file in self.files.items() if self.missions[name] is not file]

    def load(self, leave: str | None = None) -> None:
        """Apply the adopted calibrations to the file's missions, except for spacecraft `leave`."""
        self._leave = leave
        with self._lock:
            before = dict(self.missions)
            with self._readers.reading_record() as connection:
                self._loaded = newest_adoption(connection)
                adopted = adopted_missions(connection, self.files, leave)
            self.missions.update({**self.files, **adopted})
            if self.missions != before:
                self._tell()

    @contextmanager
    def replacing(self, mission: Mission) -> Iterator[None]:
        """Replace a mission after the `with` block that records its adoption has succeeded."""
        with self._lock:
            yield
            self.missions[mission.name] = mission
            self._tell()

    def _tell(self) -> None:
        for call in self._when_changed:
            call()


def adopted_missions(
    connection: Connection, files: Mapping[str, Mission], leave: str | None = None
) -> dict[str, Mission]:
    """Missions of the files with an adopted calibration applied, except for `leave`."""
    found: dict[str, Mission] = {}
    for each in latest_adoptions(connection):
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
    """SHA-256 of the alignment, focal plane and magnitudes of all trackers, prefixed `sha256:`."""
    geometries = [msgspec.to_builtins(geometry_of(each)) for each in mission.trackers]
    for each, tracker in zip(geometries, mission.trackers, strict=True):
        # Adoptions by versions without magnitudes hold the digest of the other values.
        if tracker.magnitudes == AS_MEASURED:
            del each["magnitudes"]
    return "sha256:" + hashlib.sha256(msgspec.json.encode(geometries)).hexdigest()


def with_geometry(mission: Mission, trackers: Sequence[TrackerGeometry]) -> Mission:
    """Copy of a mission with the calibrations of the given trackers; others stay unchanged."""
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
