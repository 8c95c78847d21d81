"""Differences of two interface descriptions (`openapi.yaml`) that a client can notice.

Descriptions, summaries, titles and examples may differ.  Everything else is
compared: paths, methods, operationIds, components, properties, types, required
fields, defaults, patterns, enums, scopes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from benchmarks.compare.answers import MISSING, Difference

PROSE = frozenset({"description", "summary", "title", "example", "examples", "externalDocs"})
NAMED = frozenset(
    {
        "paths",
        "schemas",
        "properties",
        "patternProperties",
        "$defs",
        "responses",
        "headers",
        "content",
        "securitySchemes",
        "mapping",
        "scopes",
        "callbacks",
        "links",
        "requestBodies",
        "parameters",
    }
)
"""Fields of the format whose keys are freely chosen names."""
VERBATIM = frozenset({"default", "const"})
UNORDERED = frozenset({"required", "enum", "type"})
METHODS = frozenset({"get", "put", "post", "delete", "patch", "head", "options", "trace"})
_SCHEMAS = "#/components/schemas/"


def normalised(document: Mapping[str, Any]) -> dict[str, Any]:
    """Description without prose; unordered lists become mappings from their members."""
    shown: dict[str, Any] = _normalised(document)
    shown.get("info", {}).pop("version", None)
    return shown


def _normalised(value: Any, key: str = "", named: bool = False) -> Any:
    if key in VERBATIM and not named:
        return {"is": value}
    if isinstance(value, Mapping):
        return {
            str(name): _normalised(each, str(name), key in NAMED and not named)
            for name, each in value.items()
            if (key in NAMED and not named) or name not in PROSE
        }
    if isinstance(value, list):
        if key in UNORDERED and not named:
            return {str(each): True for each in value}
        if key in ("parameters", "tags") and all(isinstance(each, Mapping) for each in value):
            return {_name_of(each): _normalised(each) for each in value}
        return [_normalised(each) for each in value]
    # One type alone and a list of one type say the same.
    return {str(value): True} if key == "type" and not named else value


def _name_of(entry: Mapping[str, Any]) -> str:
    name = entry.get("name", entry.get("$ref", ""))
    return f"{entry['in']} {name}" if "in" in entry else str(name)


def interface_differences(base: Mapping[str, Any], here: Mapping[str, Any]) -> list[Difference]:
    """All differences that a client can notice; see `is_addition`."""
    one, other = normalised(base), normalised(here)
    return list(_differences(one, other, _Place((), False, _asked_of_clients(other))))


def _asked_of_clients(document: Mapping[str, Any]) -> frozenset[str]:
    """Names of the components that requests contain, at any depth."""
    schemas = document.get("components", {}).get("schemas", {})
    found: set[str] = set()
    ahead = [
        operation.get("requestBody")
        for methods in document.get("paths", {}).values()
        for method, operation in methods.items()
        if method in METHODS
    ]
    while ahead:
        for name in _references(ahead.pop()):
            if name not in found:
                found.add(name)
                ahead.append(schemas.get(name))
    return frozenset(found)


def _references(value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        target = value.get("$ref")
        if isinstance(target, str) and target.startswith(_SCHEMAS):
            yield target.removeprefix(_SCHEMAS)
        for each in value.values():
            yield from _references(each)
    elif isinstance(value, list):
        for each in value:
            yield from _references(each)


NOTHING = "<nothing>"
"""Placeholder for a missing base value if a new entry is no addition, such as a new limit."""
_GROWING = frozenset({"enum", "tags"})


@dataclass(frozen=True)
class _Place:
    """Position in the description; `named`: the keys of the mapping at it are names.

    `asked` names the components that requests contain.
    """

    path: tuple[str, ...]
    named: bool
    asked: frozenset[str]

    @property
    def key(self) -> str:
        return "" if not self.path or self.named else self.path[-1]

    @property
    def is_request(self) -> bool:
        """True if clients must send the value at this position."""
        component = self.path[2] if self.path[:2] == ("components", "schemas") else None
        return component in self.asked or "requestBody" in self.path

    def below(self, name: str) -> "_Place":
        return _Place((*self.path, name), name in NAMED and not self.named, self.asked)

    def adds(self, name: str, value: Any) -> bool:
        """True if existing clients need no change for a new entry."""
        if self.path[-1:] == ("parameters",):
            return not (isinstance(value, Mapping) and value.get("required"))
        if len(self.path) == 2 and self.path[0] == "paths":
            return name in METHODS
        return self.named or (self.path[-1:] != () and self.path[-1] in _GROWING)


def _differences(base: Any, here: Any, place: _Place) -> Iterator[Difference]:
    path = "/".join(place.path)
    if isinstance(base, dict) and isinstance(here, dict):
        if not place.named and not place.is_request and "required" in base and "required" in here:
            here = here | {"required": _of_earlier_properties(base, here)}
        for name in [*base, *(each for each in here if each not in base)]:
            at = f"{path}/{name}" if path else name
            if name not in here:
                yield Difference(at, _short(base[name]), NOTHING)
            elif name in base:
                yield from _differences(base[name], here[name], place.below(name))
            else:
                adds = place.adds(name, here[name])
                yield Difference(at, MISSING if adds else NOTHING, _short(here[name]))
    elif isinstance(base, list) and isinstance(here, list) and len(base) == len(here):
        for index, (one, other) in enumerate(zip(base, here, strict=True)):
            yield from _differences(one, other, place.below(str(index)))
    elif type(base) is not type(here) or base != here:
        yield Difference(path, _short(base), _short(here))


def _of_earlier_properties(base: Mapping[str, Any], here: Mapping[str, Any]) -> Any:
    """Required properties without new ones: answers may have more fields."""
    if not isinstance(here["required"], Mapping):
        return here["required"]
    new = set(here.get("properties", {})) - set(base.get("properties", {}))
    return {name: value for name, value in here["required"].items() if name not in new}


def _short(value: Any, most: int = 200) -> str:
    text = str(value)
    return text if len(text) <= most else f"{text[:most]}..."
