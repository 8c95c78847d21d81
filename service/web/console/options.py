"""Options from the fields of a form, and the fields to show.

A form sends every field; only a changed value is an option.  Names are those of the mission file,
dotted and prefixed in a query string: `b.tolerances.separation_deg`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import ValidationError

from service.acquire.choices import Choices, idle_reason
from service.errors import BadBatch, Fault, shown_value
from service.missions.faults import causes, plain_message
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Mission, SolverName, Tests, Tolerances
from service.observations.schema import OptionsIn

SYMBOLS: Mapping[str, str] = {
    "pair_separation_max_deg": "HMAX",
    "separation_deg": "SEPTOL",
    "magnitude_mag": "XMTOL",
    "magnitude_order_mag": "TMAGMX",
    "cross_product_deg": "CAPMAX, BANMAX",
    "pole_difference_deg": "BANTOL1",
    "pole_angle_deg": "BANTOL2",
}
"""Symbols of the settings in the paper (Fink & Shoup 1994, Table 1)."""

SWITCH = {"on": True, "off": False}


@dataclass(frozen=True)
class FormField:
    """Form field of one setting: its name in the query, current value, and previous value."""

    name: str
    label: str
    symbol: str
    unit: str
    value: Any
    before: Any
    choices: tuple[str, ...] = ()
    group: str = ""

    @property
    def changed(self) -> bool:
        """True if the value in the form differs from the setting."""
        return bool(self.value != self.before)


def asked_options(query: Mapping[str, str], prefix: str = "") -> dict[str, Any]:
    """Options of a query string, nested as in the API; empty fields are left out.

    Raises `BadBatch` for unknown names and impossible values.
    """
    nested: dict[str, Any] = {}
    for name, text in query.items():
        if not name.startswith(prefix) or not text.strip():
            continue
        group, _, leaf = name.removeprefix(prefix).rpartition(".")
        place = nested.setdefault(group, {}) if group else nested
        place[leaf] = _value(name, group, leaf, text.strip())
    try:
        OptionsIn.model_validate(nested)
    except ValidationError as error:
        raise BadBatch(faults_of_form(error, prefix)) from None
    return nested


def _value(name: str, group: str, leaf: str, text: str) -> Any:
    if group == "tests":
        if text not in SWITCH:
            raise BadBatch(Fault(name[:80], "must be on or off", shown_value(text)))
        return SWITCH[text]
    if group == "tolerances" or leaf == "zone_grid_deg":
        try:
            return float(text)
        except ValueError:
            raise BadBatch(Fault(name[:80], "must be a number", shown_value(text))) from None
    return text


def faults_of_form(error: ValidationError, prefix: str = "") -> list[Fault]:
    """Faults of a form, by field name."""
    return [
        Fault(
            prefix + ".".join(str(part)[:80] for part in each["loc"]),
            plain_message(each),
            shown_value(each["input"]),
        )
        for each in causes(error.errors())
    ]


def changed_options(asked: Mapping[str, Any], choices: Choices) -> OptionsIn:
    """Requested options that differ from the current settings."""
    held = batch_settings(choices)
    changed: dict[str, Any] = {}
    for name, value in asked.items():
        if isinstance(value, dict):
            differing = {leaf: each for leaf, each in value.items() if each != held[name][leaf]}
            if differing:
                changed[name] = differing
        elif value != held[name]:
            changed[name] = value
    return OptionsIn.model_validate(changed)


def batch_settings(choices: Choices) -> dict[str, Any]:
    """Current settings for a batch, nested like options."""
    return _nested(choices, choices.zone_grid_deg)


def settings_of_mission(mission: Mission) -> dict[str, Any]:
    """Settings that apply if neither batch nor form has others."""
    return _nested(mission, mission.zone.grid_deg)


def _nested(settings: Choices | Mission, zone_grid_deg: float | None) -> dict[str, Any]:
    return {
        "identifier": settings.identifier,
        "solver": settings.solver,
        "tests": settings.tests.model_dump(),
        "tolerances": settings.tolerances.model_dump(),
        "zone_grid_deg": zone_grid_deg,
    }


def fields_of(
    asked: Mapping[str, Any],
    before: Mapping[str, Any] | None,
    prefix: str = "",
    mission: Mission | None = None,
) -> list[FormField]:
    """Fields of a form; without settings `before` they start empty.

    With a mission, fields without effect under the form's identifier and tests are left out.
    """
    held = before or {}
    in_force = before or ({} if mission is None else settings_of_mission(mission))

    def acts(leaf: str) -> bool:
        if mission is None:
            return True
        tests = Tests.model_validate({**in_force["tests"], **asked.get("tests", {})})
        identifier = asked.get("identifier", in_force["identifier"])
        return idle_reason(leaf, identifier, tests, mission.zone) is None

    def field(leaf: str, group: str = "", choices: Iterable[str] = ()) -> FormField:
        at = held.get(group, {}) if group else held
        wanted = asked.get(group, {}) if group else asked
        was = at.get(leaf)
        label, _, unit = leaf.rpartition("_")
        if group != "tolerances":
            label, unit = leaf, ""
        name = f"{prefix}{group}.{leaf}" if group else f"{prefix}{leaf}"
        value = wanted.get(leaf, was)
        words = label.replace("_", " ")
        symbol = SYMBOLS.get(leaf, "") if group == "tolerances" else ""
        return FormField(name, words, symbol, unit, value, was, tuple(choices), group or "method")

    return [
        field("identifier", choices=tuple(IDENTIFIERS)),
        field("solver", choices=get_args(SolverName)),
        *(field(leaf, "tests", SWITCH) for leaf in Tests.model_fields if acts(leaf)),
        *(field(leaf, "tolerances") for leaf in Tolerances.model_fields if acts(leaf)),
    ]


def toml_of(fields: Iterable[FormField]) -> str:
    """Changed settings as lines of a mission file, each with the value that it replaces."""
    tables: dict[str, list[str]] = {"": [], "tests": [], "tolerances": []}
    for each in fields:
        if not each.changed:
            continue
        group, _, leaf = each.name.rpartition(".")
        tables[group].append(f"{leaf} = {_toml(each.value)}  # was {_toml(each.before)}")
    parts = [
        "\n".join([*([f"[{name}]"] if name else []), *lines])
        for name, lines in tables.items()
        if lines
    ]
    return "\n\n".join(parts) + "\n" if parts else ""


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else repr(value)
