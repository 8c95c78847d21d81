"""The page of missions: what each is set to, and what it was set to before."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.dashboard.options import SYMBOLS
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery

router = APIRouter(include_in_schema=False, route_class=PageRoute)


@dataclass(frozen=True)
class Change:
    """One setting that differs from what it was; None where it was not there."""

    name: str
    before: Any
    after: Any


@dataclass(frozen=True)
class Entry:
    """Settings that came into force, and how they differ from those before them."""

    digest: str
    since: str
    changes: tuple[Change, ...]
    is_first: bool


@router.get("/missions")
def missions_page(query: Annotated[RunQuery, InQuery()], desk: AtDesk) -> Response:
    """Every mission's settings, section by section, with their history."""
    missions = []
    for name in desk.spacecraft:
        state = desk.operations.spacecraft_state(name)
        settings = state["mission"]["settings"]
        missions.append(
            {
                "name": name,
                "description": state["description"],
                "digest": state["mission"]["digest"],
                "sections": list(_sections(settings)),
                "history": list(reversed(_entries(state["history"]))),
            }
        )
    return rendered(
        "missions.html.jinja",
        desk.shell(query.run, "/missions"),
        missions=missions,
        symbols=SYMBOLS,
    )


def _sections(settings: Mapping[str, Any]) -> Iterator[tuple[str, list[tuple[str, Any]]]]:
    """Titles with their settings, flat: a tracker is a section of its own."""
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


def _entries(history: Sequence[Mapping[str, Any]]) -> list[Entry]:
    entries: list[Entry] = []
    before: dict[str, Any] = {}
    for each in history:
        after = dict(_flat(each["settings"]))
        changes = tuple(
            Change(name, before.get(name), after.get(name))
            for name in sorted({*before, *after})
            if before.get(name) != after.get(name)
        )
        since = each["since"] if "since" in each else each["first_used"]
        entries.append(Entry(each["digest"], since, changes, is_first=not entries))
        before = after
    return entries
