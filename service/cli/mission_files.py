"""A whole mission as TOML, each value with its origin."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.missions.defaults import completed

if TYPE_CHECKING:
    from service.missions.mission import Mission

ORIGIN_COLUMN = 52


def whole_text(mission: "Mission", path: Path) -> str:
    """The mission of a file as a TOML file that states every value, with its origin beside it."""
    given = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    origins = _Origins(given, completed(given).origins)
    tables = mission.model_dump(mode="json") | {
        "a_priori_error_deg": mission.a_priori_error_deg,
        "sun_pointed_axis_body": mission.sun_pointed_axis_body,
    }
    for shown, tracker in zip(tables["trackers"], mission.trackers, strict=True):
        shown["field_of_view_deg"] = tracker.field_of_view_deg
        shown["limit_mag"] = tracker.limit_mag
    return "\n".join([f"# {path}", *_table("", tables, origins)])


class _Origins:
    """Where the values of a mission come from."""

    def __init__(self, given: Mapping[str, Any], derived: Mapping[str, str]) -> None:
        self._given, self._derived = given, derived

    def of(self, key: str) -> str:
        """The origin of the value with a dotted key, as a comment."""
        if self._is_given(key):
            return "given"
        if key in self._derived:
            return f"derived: {self._derived[key]}"
        return "from the table [camera]" if "camera" in self._given else "default"

    def _is_given(self, key: str) -> bool:
        value: Any = self._given
        for part in key.split("."):
            if isinstance(value, list):
                value = dict(enumerate(value)).get(int(part))
            elif isinstance(value, dict) and part in value:
                value = value[part]
            else:
                return False
        return True


def _table(name: str, table: Mapping[str, Any], origins: _Origins, prefix: str = "") -> list[str]:
    plain: list[str] = []
    below: list[str] = []
    for key, value in table.items():
        dotted = f"{prefix}{key}"
        title = f"{name}.{key}" if name else key
        if value is None:
            continue
        if isinstance(value, dict):
            below += ["", f"[{title}]", *_table(title, value, origins, f"{dotted}.")]
        elif value and isinstance(value, list) and isinstance(value[0], dict):
            for place, each in enumerate(value):
                below += ["", f"[[{title}]]", *_table(title, each, origins, f"{dotted}.{place}.")]
        else:
            setting = f"{key} = {_value(value)}"
            plain.append(f"{setting:<{ORIGIN_COLUMN}}  # {origins.of(dotted)}")
    return plain + below


def _value(value: Any) -> str:
    """A value in TOML's notation, which is JSON's for numbers, texts and lists of both."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value, ensure_ascii=False)
