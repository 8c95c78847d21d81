"""Text of mission files: a complete one with the origin of every value, and a short new one."""

import json
import sys
import tomllib
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import BadInput, Fault, shown_value
from service.missions.defaults import completed

if TYPE_CHECKING:
    from service.missions.mission import Mission


def whole_text(mission: "Mission", path: Path) -> str:
    """Complete TOML text of a mission, with the origin of each value as a comment."""
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
    """Finds the origin of each value of a mission: given, derived or default."""

    def __init__(self, given: Mapping[str, Any], derived: Mapping[str, str]) -> None:
        self._given, self._derived = given, derived

    def of(self, key: str) -> str:
        """Origin of the value with a dotted key, as text of a comment."""
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
            plain.append(f"{setting:<52}  # {origins.of(dotted)}")
    return plain + below


def _value(value: Any) -> str:
    """Value in TOML notation, equal to JSON for numbers, texts and lists."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value, ensure_ascii=False)


AXES = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}
ACROSS = {"x": "y", "y": "z", "z": "x"}
"""Body axis used as the tracker's X axis for a boresight along another body axis."""
QUESTIONS = (
    ("name", "Name of the spacecraft", "MYCUBE"),
    ("field", "Field of view of the tracker in degrees: WIDTHxHEIGHT, or the radius", "8x8"),
    ("sigma", "Error of a star's position along each axis, one sigma, in arcsec", "5"),
    ("limit", "Faintest star that the tracker sees, in magnitudes", "6.5"),
    ("boresight", "Body axis of the boresight: x, -x, y, -y, z, -z, or three numbers", "z"),
    (
        "a_priori_error",
        "Largest a priori error about each axis, in degrees; nothing: no a priori attitude",
        "0.5",
    ),
    ("sun_axis", "Body axis on the Sun, if only the Sun's direction is known; else nothing", ""),
)
"""Options of `acquire mission new` with their questions and examples."""


def asked(parsed: Namespace) -> Namespace:
    """Complete the options of a new mission by asking for missing ones on the terminal.

    Questions go to standard error, so that the file can be redirected.
    """
    for name, question, example in QUESTIONS:
        if getattr(parsed, name) is None:
            such = f", such as {example}" if example else ""
            print(f"{question}{such}: ", end="", file=sys.stderr, flush=True)
            answer = sys.stdin.readline().strip()
            repeats = name in ("field", "sigma", "limit", "boresight")
            setattr(parsed, name, ([answer] if repeats else answer) if answer else None)
    return parsed


def new_text(parsed: Namespace) -> str:
    """Text of a new mission file with comments; raises `BadInput` naming the option at fault."""
    for name in ("name", "field", "sigma", "limit"):
        if not getattr(parsed, name):
            option = "NAME" if name == "name" else f"--{name}"
            example = next(each for key, _, each in QUESTIONS if key == name)
            raise BadInput(Fault(option, f"is required, such as {example}"))
    lines = [f"name = {_value(parsed.name)}"]
    if parsed.identifier:
        lines.append(f"identifier = {_value(parsed.identifier)}")
    if parsed.sun_axis:
        axis = _axis("--sun-axis", parsed.sun_axis)
        lines.append(_line(f"sun_pointed_axis_body = {axis}", "the body axis on the Sun"))
    if parsed.a_priori_error is not None:
        error_deg = _number("--a-priori-error", parsed.a_priori_error)
        about = "of the Sun-pointed axis" if parsed.sun_axis else "about each axis"
        lines.append(_line(f"a_priori_error_deg = {error_deg}", f"largest a priori error {about}"))
    elif not parsed.sun_axis:
        lines.append("# Without a_priori_error_deg the mission is lost in space.")
    boresights = parsed.boresight or ["z"]
    for place in range(max(len(boresights), len(parsed.field))):
        lines += ["", *_tracker(parsed, place)]
    return "\n".join(lines) + "\n"


def _tracker(parsed: Namespace, place: int) -> list[str]:
    boresight = _of_tracker(parsed.boresight or ["z"], place)
    z_axis = _axis("--boresight", boresight)
    x_axis = _axis("--boresight", ACROSS.get(boresight.lstrip("+-").lower(), ""), z_axis)
    sigma = _number("--sigma", _of_tracker(parsed.sigma, place))
    limit = _number("--limit", _of_tracker(parsed.limit, place))
    return [
        "[[trackers]]",
        _line(f"x_axis_body = {x_axis}", "the tracker's X axis in body components: check it"),
        _line(f"z_axis_body = {z_axis}", "the boresight; the tracker's Y axis follows"),
        _field(_of_tracker(parsed.field, place)),
        _line(f"sigma_arcsec = {sigma}", "one sigma of a position along each axis"),
        _line(f"limit_mag = {limit}", "the faintest star that the tracker sees"),
    ]


def _of_tracker(values: list[str], place: int) -> str:
    """Value of an option for one tracker; the last value applies to all further trackers."""
    return str(values[min(place, len(values) - 1)])


def _field(text: str) -> str:
    width, times, height = text.lower().partition("x")
    if not times:
        radius_deg = _number("--field", text, "8x8 (width and height), or a radius such as 4")
        return _line(f"field_of_view_radius_deg = {radius_deg}", "from the boresight to the edge")
    sides = [_number("--field", each, "WIDTHxHEIGHT, such as 8x8") for each in (width, height)]
    return _line(f"field_of_view_deg = {sides}", "width along X, height along Y")


def _axis(option: str, text: str, across: list[float] | None = None) -> list[float]:
    """Unit vector of a body axis from text: x, -x, ..., or three numbers; or one perpendicular."""
    name = text.lstrip("+-").lower()
    if name in AXES:
        sign = -1.0 if text.startswith("-") else 1.0
        return [sign * each + 0.0 for each in AXES[name]]
    if across is not None:
        return _perpendicular(across)
    try:
        first, second, third = (float(each) for each in text.replace(",", " ").split())
        norm = (first**2 + second**2 + third**2) ** 0.5
        return [round(each / norm, 9) + 0.0 for each in (first, second, third)]
    except (ValueError, ZeroDivisionError):
        message = "must be x, -x, y, -y, z, -z, or three numbers such as 0.6,0,0.8"
        raise BadInput(Fault(option, message, shown_value(text))) from None


def _perpendicular(axis: list[float]) -> list[float]:
    """Unit vector perpendicular to an axis, nearest to the body axis most nearly across it."""
    k = min(range(3), key=lambda place: abs(axis[place]))
    aside = [(1.0 if place == k else 0.0) - axis[k] * axis[place] for place in range(3)]
    norm = sum(each**2 for each in aside) ** 0.5
    return [round(each / norm, 9) + 0.0 for each in aside]


def _number(option: str, text: str, example: str = "a number above 0, such as 5") -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    # A limiting magnitude may be below zero; the check of the mission bounds every value.
    if number == 0.0:
        raise BadInput(Fault(option, f"must be {example}", shown_value(text)))
    return number


def _line(setting: str, comment: str) -> str:
    return f"{setting:<36}  # {comment}"
