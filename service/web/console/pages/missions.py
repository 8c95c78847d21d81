"""Page of missions: their settings with history."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from starlette.responses import Response

from service.contract.spacecraft import MissionThen
from service.errors import BadConfiguration
from service.observations.schema import Key
from service.web.console.options import SYMBOLS
from service.web.console.page import ContextDep, FromQuery, PageQuery, console_page
from service.web.requests.access import Policy

MOST_SHOWN = 8
"""Greatest number of missions whose settings are all shown without a choice."""


@dataclass(frozen=True)
class SettingDifference:
    """Setting that changed; None on the side where it did not exist."""

    name: str
    before: Any
    after: Any

    @property
    def factor(self) -> float | None:
        """Ratio of the new number to the old one; None if one is no number, or the old is 0."""
        numbers = [
            each
            for each in (self.before, self.after)
            if isinstance(each, int | float) and not isinstance(each, bool)
        ]
        return numbers[1] / numbers[0] if len(numbers) == 2 and numbers[0] else None


@dataclass(frozen=True)
class SettingsEntry:
    """Version of a mission's settings, and its differences from the previous one."""

    digest: str
    since: str
    changes: tuple[SettingDifference, ...]
    is_first: bool


class MissionsQuery(PageQuery):
    """Query for the mission whose settings are shown in full; an empty field selects all."""

    spacecraft: Key | Literal[""] = ""


@console_page("/missions", "Missions", Policy("read", "nothing"), position=70)
def missions_page(query: FromQuery[MissionsQuery], context: ContextDep) -> Response:
    """Page with settings and their history, for all of a few missions, or for the chosen one."""
    if query.spacecraft:
        context.caller.require(query.spacecraft)
        context.app.context.mission(query.spacecraft)
    names = context.spacecraft
    chosen = names if len(names) <= MOST_SHOWN else []
    if query.spacecraft:
        chosen = [query.spacecraft]
    missions = []
    try:
        changed, unreadable = context.app.adoptions.changed_files(), None
    except BadConfiguration as error:
        changed, unreadable = {}, str(error)
    for name in chosen:
        state = context.app.spacecraft.state(name)
        settings = state.mission.settings
        missions.append(
            {
                "name": name,
                "description": state.description,
                "retired": state.retired,
                "changed": changed.get(name),
                "digest": state.mission.digest,
                "sections": list(_sections(settings)),
                "history": list(reversed(_entries(state.history))),
            }
        )
    return context.rendered(
        "missions.html.jinja",
        query.run,
        missions=missions,
        known=[context.app.context.known[name] for name in names],
        changed=changed,
        query=query,
        # The error text may name missions of other spacecraft.
        unreadable=unreadable if context.caller.spacecraft is None else None,
        symbols=SYMBOLS,
    )


def _sections(settings: Mapping[str, Any]) -> Iterator[tuple[str, list[tuple[str, Any]]]]:
    """Sections of a mission's settings, each a title and flat settings; one for each tracker."""
    plain = [(k, v) for k, v in settings.items() if not isinstance(v, dict | list)]
    yield "general", [each for each in plain if each[0] not in ("name", "description")]
    for name, value in settings.items():
        if isinstance(value, dict):
            yield name, list(_flat(value))
        elif isinstance(value, list):
            for tracker in value:
                rest = {key: each for key, each in tracker.items() if key != "name"}
                yield f"tracker {tracker['name']}", list(_flat(rest))


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for each in value:
                yield from _flat(each, f"{prefix}{name}.{each.get('name', '')}.")
        else:
            yield f"{prefix}{name}", value


def _entries(history: Sequence[MissionThen]) -> list[SettingsEntry]:
    entries: list[SettingsEntry] = []
    before: dict[str, Any] = {}
    for each in history:
        after = dict(_flat(each.settings))
        changes = tuple(
            SettingDifference(name, before.get(name), after.get(name))
            for name in sorted({*before, *after})
            if before.get(name) != after.get(name)
        )
        entries.append(SettingsEntry(each.digest, each.since, changes, is_first=not entries))
        before = after
    return entries
