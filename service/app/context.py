"""Settings, missions, sky and database, shared by the parts of the app."""

from collections import ChainMap
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypedDict, TypeVar

from pydantic import TypeAdapter, ValidationError
from sqlalchemy import Connection

from service.access import Entry
from service.contract.alarms import Alarm
from service.contract.base import Page
from service.errors import BadBatch, Fault, NotFound, shown_value
from service.feature import SETTING, feature_modules, features_on
from service.missions.faults import plain_message
from service.missions.mission import Mission, mission_named
from service.observations.schema import LIVE, RunName
from service.settings import Settings
from service.sky.model import SkyModel
from service.storage.queries.histories import Retired
from service.storage.recording.ids import is_ulid
from service.storage.store import Store
from service.times import Utc, utc_now
from service.trends.quantities import limited_trackers

ALL_RUNS = "*"
"""Text accepted in place of a run's name for every run, the live one included."""

_RUN_NAME = TypeAdapter(RunName)

T = TypeVar("T")


class PageOfPeriod(TypedDict, total=False):
    """Options of a page of a list: period, run (the live one by default), size and cursor."""

    run: str | None
    start: Utc | None
    end: Utc | None
    limit: int
    cursor: str | None


@dataclass(frozen=True)
class Context:
    """Settings, missions, sky and store, shared by every part of the app."""

    settings: Settings
    missions: dict[str, Mission]
    sky: SkyModel
    store: Store
    retired: Retired = field(default_factory=Retired)

    @cached_property
    def known(self) -> Mapping[str, Mission]:
        """Missions of the files, with the last settings of retired spacecraft."""
        return ChainMap(self.missions, self.retired.missions)

    def mission(self, name: str) -> Mission:
        """Mission of a spacecraft, including retired ones; raises `NotFound`."""
        return mission_named(self.known, name)

    def trackers(self, name: str) -> tuple[str, ...]:
        """Trackers of a spacecraft that have values of their own, followed by retired ones."""
        return (*limited_trackers(self.mission(name)), *self.retired.trackers.get(name, ()))

    def has_feature(self, name: str) -> bool:
        """True if a feature is installed and the settings do not switch it off."""
        return any(each.name == name for each in features_on(self.settings.features_off))

    def require_alarms(self, wanted: bool) -> None:
        """Raise `BadBatch` if alarms are requested while that feature is switched off."""
        if wanted and not self.has_feature("alarms"):
            message = f"are off in this service ({SETTING}): nothing would evaluate the limits"
            raise BadBatch(Fault("alarms", message, "true"))

    def reading(self) -> AbstractContextManager[Connection]:
        """Provide a connection with one snapshot of the record and its projections; see `Store`."""
        return self.store.reading()

    def active_alarms(self, connection: Connection, run: str) -> list[Alarm]:
        """Alarms of a run that are not cleared, the worst present severity first."""
        modules = feature_modules("state", self.settings.features_off)
        now = utc_now().text
        return [each for one in modules for each in one.active_alarms(connection, run, now)]

    def reading_record(self) -> AbstractContextManager[Connection]:
        """Provide a connection for reading recorded data, which need not wait for projections."""
        return self.store.reading_record()

    def reading_batch(self, id: str) -> AbstractContextManager[tuple[Connection, bool]]:
        """Provide a connection that holds the batch of a result; see `Store.reading_batch`."""
        return self.store.reading_batch(id)

    def page(
        self,
        listing: Callable[..., Page[T]],
        selection: Callable[..., object],
        name: str,
        asked: PageOfPeriod,
    ) -> Page[T]:
        """Page of a list about a spacecraft; raises `NotFound` for an unknown one.

        `listing` reads the page for the filter that `selection` builds from run, spacecraft, start
        and end.
        """
        self.mission(name)
        selected = selection(
            run=asked.get("run") or LIVE,
            spacecraft=name,
            start=asked.get("start"),
            end=asked.get("end"),
        )
        limit, cursor = asked.get("limit", 100), asked.get("cursor")
        with self.reading() as connection:
            return listing(connection, selected, limit=limit, cursor=cursor)

    def change(self, change: Callable[[Connection], T]) -> T:
        """Change the database in one transaction, and wait until it is committed."""
        return self.store.writer.change(change)

    def change_audited(self, change: Callable[[Connection], T], entry: Entry | None) -> T:
        """Change the database with an entry in the audit list, in one transaction.

        The projector evaluates all earlier batches first: an operator acts on alarms as the page
        showed them, and a new limit holds from the next batch on.
        """
        self.store.progress.wait()

        def audited(connection: Connection) -> T:
            changed = change(connection)
            if entry is not None:
                entry.add_to(connection)
            return changed

        return self.change(audited)


def known_id(id: str, what: str) -> str:
    """Check the form of an id and return it; raises `NotFound` for one such as `x`."""
    # A malformed id needs no query.
    if not is_ulid(id):
        raise NotFound(f"there is no {what} with the id {shown_value(id)}")
    return id


def checked_run_name(text: str) -> str:
    """Check the name of a run; raises `BadBatch` for an invalid one."""
    try:
        return _RUN_NAME.validate_python(text)
    except ValidationError as error:
        message = plain_message(error.errors()[0])
        raise BadBatch(Fault("run", message, shown_value(text))) from None
