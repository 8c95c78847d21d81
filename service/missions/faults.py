"""Validation errors of pydantic, in the service's words and ordered by cause.

Consequential errors are left out: a table that is incomplete because one of its values is wrong, or
a missing key whose name was misspelt.
"""

import difflib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel

Location = tuple[str | int, ...]
PydanticFault = Mapping[str, Any]

EXAMPLES: dict[str, Any] = {
    "name": "MYCUBE",
    "a_priori_error_deg": 0.5,
    "sun_pointed_axis_body": [1.0, 0.0, 0.0],
    "x_axis_body": [1.0, 0.0, 0.0],
    "y_axis_body": [0.0, 1.0, 0.0],
    "z_axis_body": [0.0, 0.0, 1.0],
    "axis_body": [1.0, 0.0, 0.0],
    "field_of_view_deg": [8.0, 8.0],
    "field_of_view_radius_deg": 4.0,
    "sigma_arcsec": 5.0,
    "limit_mag": 6.5,
    "magnitude_sigma_mag": 0.1,
    "identifier": "verified",
    "solver": "quest",
    "kind": "cap",
    "radius_deg": 10.66,
    "half_width_deg": 2.1,
    "coelevation_deg": 90.0,
    "grid_deg": 1.0,
    "pair_separation_max_deg": 8.0,
    "separation_deg": 0.0066,
    "magnitude_mag": 0.6,
    "magnitude_order_mag": 0.6,
    "cross_product_deg": 90.0,
    "magnitude_limit_mag": 6.5,
    "epoch_step_years": 1.0,
    "merge_within_arcsec": 60.0,
    "width_px": 1024,
    "height_px": 1024,
    "focal_length_px": 5852.0,
    "sigma_v_rad_s0_5": 1e-6,
    "sigma_u_rad_s1_5": 1e-9,
    "spacecraft": "XTE",
    "batch": "1996-010-0001",
    "time": "1996-01-10T12:00:00.000Z",
    "tracker": "STARTRACKER_1",
    "quaternion": [0.0, 0.0, 0.0, 1.0],
    "vector": [0.0, 0.0, 1.0],
    "h_deg": 0.52,
    "v_deg": -1.21,
    "ra_deg": 83.1,
    "dec_deg": -2.4,
    "magnitude": 5.31,
    "time_offset_s": 0.0,
    "frame": "EME2000",
    "aberration": "to_correct",
    "body_rates_deg_per_s": [0.0, 0.0, 0.0],
    "velocity_km_per_s": [0.0, 7.5, 0.0],
    "position_km": [6878.0, 0.0, 0.0],
    "sun_vector": [1.0, 0.0, 0.0],
    "run": "pass-7",
    "a_priori": {"quaternion": [0.0, 0.0, 0.0, 1.0]},
    "observations": [
        {"tracker": "STARTRACKER_1", "stars": [{"h_deg": 0.52, "v_deg": -1.21, "magnitude": 5.31}]}
    ],
    "stars": [{"h_deg": 0.52, "v_deg": -1.21, "magnitude": 5.31}],
}
"""Example values for the keys of missions and batches, shown in error messages."""

_UNSEEN = r"\x00-\x1f\x7f-\x9f\u00ad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff"
_SPACES = r"\x20\u00a0\u1680\u2000-\u200a\u202f\u205f\u3000"
VISIBLE_PATTERN = f"^[^{_UNSEEN}]+$"
"""A pattern for text without control characters, zero-width characters and direction marks."""
NAME_PATTERN = f"^[^{_UNSEEN}{_SPACES}](?:[^{_UNSEEN}]*[^{_UNSEEN}{_SPACES}])?$"
"""A pattern for visible text that neither begins nor ends with a space."""

FORMS: dict[str, str] = {
    r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$": (
        "must be 1 to 64 letters, digits and _ . - that begin with a letter or digit"
    ),
    r"^[A-Za-z0-9][A-Za-z0-9_.:-]*$": (
        "must be letters, digits and _ . : - that begin with a letter or digit"
    ),
    r"^[^\x00-\x1f\x7f]+$": "must be text without control characters",
    VISIBLE_PATTERN: "must be text without control characters and invisible characters",
    NAME_PATTERN: (
        "must be text without control characters, invisible characters and spaces at its ends"
    ),
}
"""Explanations of the patterns of names, for error messages."""


LONGEST_NAME = 40
"""Longest unknown name that is compared with known ones, since comparison is slow."""
LEAST_CUT = 3
"""Least length of an abbreviation that is completed to a longer name."""
MOST_COMPARED = 20
"""Largest number of unknown keys of a table that are compared with its missing ones."""


def plain_message(fault: PydanticFault) -> str:
    """A validation error in the service's words, with an example value for its key."""
    words = _WORDS.get(fault["type"])
    if words is None:
        text = str(fault["msg"]).removeprefix("Value error, ").removeprefix("Assertion failed, ")
        text = re.sub(r"^Input should (be|have) ", r"must \1 ", text)
    else:
        text = words(fault.get("ctx", {}))
    # Messages of the service itself already state what is expected.
    if fault["type"] in _WITHOUT_EXAMPLE or "options" in fault["loc"]:
        return text
    example = _example(fault["loc"])
    return text if example is None else f"{text}, such as {json.dumps(example)}"


def _example(location: Location) -> Any:
    """An example value for the key, or the list entry, at a location; None if none is known."""
    at = max((k for k, part in enumerate(location) if isinstance(part, str)), default=None)
    if at is None or (location[at] == "kind" and "zone" not in location):
        return None
    key = str(location[at])
    example = EXAMPLES.get("tracker" if key == "name" and "trackers" in location else key)
    for place in location[at + 1 :]:
        if isinstance(example, list) and isinstance(place, int):
            example = example[min(place, len(example) - 1)]
    return example


def causes(faults: Sequence[PydanticFault]) -> list[PydanticFault]:
    """Validation errors that follow from no others: unknown keys, wrong values, missing keys."""
    joined = [*map(_of_kind, _of_lists(faults))]
    # A client may send any number of unknown keys: the time must be linear in it.
    wholes: set[Location] = set()
    unknown: dict[Location, list[Any]] = {}
    for fault in joined:
        location = fault["loc"]
        wholes.update(location[:length] for length in range(len(location)))
        if fault["type"] == "extra_forbidden":
            names = unknown.setdefault(location[:-1], [])
            names += [location[-1]] if len(names) < MOST_COMPARED else []
    kept = []
    for fault in joined:
        location = fault["loc"]
        is_misspelt = fault["type"] == "missing" and any(
            nearest(each, [location[-1]]) for each in unknown.get(location[:-1], ())
        )
        if location not in wholes and not is_misspelt:
            kept.append(fault)
    return sorted(kept, key=lambda fault: _RANK.get(fault["type"], 1))


def of_the_form_given(
    faults: Sequence[PydanticFault], key_of: Callable[[PydanticFault], str]
) -> list[PydanticFault]:
    """Validation errors without those for types of a value that the file does not use.

    For a value of several types, pydantic reports one error for each.
    """
    return [
        fault
        for fault in faults
        if not fault["type"].endswith("_type")
        or all(
            other is fault or key_of(other) != key_of(fault) or other["type"].endswith("_type")
            for other in faults
        )
    ]


def nearest(name: Any, known: Sequence[Any]) -> str | None:
    """The known name most similar in spelling; None if none is, or if the name is too long."""
    if len(str(name)) > LONGEST_NAME:
        return None
    names = [*map(str, known)]
    # Either a unit was left out, such as sigma for sigma_arcsec, or a word was cut, such as mag.
    longer = [each for each in names if each.startswith(f"{name}_")] or [
        each for each in names if len(str(name)) >= LEAST_CUT and each.startswith(str(name))
    ]
    near = longer or difflib.get_close_matches(str(name), names, n=1, cutoff=0.7)
    return near[0] if near else None


def _of_kind(fault: PydanticFault) -> PydanticFault:
    """A validation error, moved to the key of a table's kind if that is wrong or missing."""
    key = str(fault.get("ctx", {}).get("discriminator", "")).strip("'")
    if fault["type"] not in ("union_tag_invalid", "union_tag_not_found") or not key.isidentifier():
        return fault
    located = {"loc": (*fault["loc"], key), "msg": "", "input": fault["input"]}
    if fault["type"] == "union_tag_not_found":
        return {**located, "type": "missing"}
    expected = _either(fault["ctx"]["expected_tags"])
    value = fault["input"].get(key)
    return {**located, "type": "literal_error", "input": value, "ctx": {"expected": expected}}


_RANK = {"extra_forbidden": 0, "missing": 2}


def _of_lists(faults: Sequence[PydanticFault]) -> Iterator[PydanticFault]:
    """The validation errors, with one for a whole list instead of one for each missing entry."""
    lacking: dict[Location, int] = {}
    for fault in faults:
        location = fault["loc"]
        if fault["type"] == "missing" and location and isinstance(location[-1], int):
            lacking[location[:-1]] = max(lacking.get(location[:-1], 0), location[-1] + 1)
    done: set[Location] = set()
    for fault in faults:
        location = fault["loc"]
        if fault["type"] != "missing" or location[:-1] not in lacking:
            yield fault
        elif location[:-1] not in done:
            done.add(location[:-1])
            held = fault["input"]
            yield {
                "type": "wrong_length",
                "loc": location[:-1],
                "msg": "",
                "input": held,
                "ctx": {"length": lacking[location[:-1]], "actual_length": len(held)},
            }


_WITHOUT_EXAMPLE = ("value_error", "literal_error", "extra_forbidden", "bool_type", "bool_parsing")


def _entries(context: Mapping[str, Any], key: str, bound: str) -> str:
    count, held = context[key], context.get("actual_length")
    noun = "entry" if count == 1 else "entries"
    return f"must have {bound}{count} {noun}, not {held}"


_WORDS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "missing": lambda c: "is required",
    "greater_than": lambda c: f"must be above {c['gt']:g}",
    "greater_than_equal": lambda c: f"must be at least {c['ge']:.10g}",
    "less_than": lambda c: f"must be below {c['lt']:g}",
    "less_than_equal": lambda c: f"must be at most {c['le']:.10g}",
    "finite_number": lambda c: "must be a finite number",
    **dict.fromkeys(("float_type", "float_parsing"), lambda c: "must be a number"),
    **dict.fromkeys(
        ("int_type", "int_parsing", "int_from_float", "int_parsing_size"),
        lambda c: "must be a whole number",
    ),
    **dict.fromkeys(("bool_type", "bool_parsing"), lambda c: "must be true or false"),
    "string_type": lambda c: "must be text",
    "string_too_short": lambda c: (
        "must not be empty" if c["min_length"] == 1 else f"must have {c['min_length']} characters"
    ),
    "string_too_long": lambda c: f"must have at most {c['max_length']} characters",
    "string_pattern_mismatch": lambda c: FORMS.get(
        c["pattern"], f"must be text of the form {c['pattern']}"
    ),
    "literal_error": lambda c: f"must be {c['expected']}",
    "enum": lambda c: f"must be {c['expected']}",
    "extra_forbidden": lambda c: "there is no such field",
    **dict.fromkeys(("tuple_type", "list_type"), lambda c: "must be a list"),
    "wrong_length": lambda c: _entries(c, "length", ""),
    "too_short": lambda c: _entries(c, "min_length", "at least "),
    "too_long": lambda c: _entries(c, "max_length", "at most "),
    **dict.fromkeys(
        ("model_type", "model_attributes_type", "dict_type"),
        lambda c: "must be a table of keys and values",
    ),
}


def _either(tags: str) -> str:
    """The allowed tags of a union, which pydantic separates by commas, joined by "or"."""
    return " or ".join(tags.split(", "))


def dotted_key(model: type[BaseModel], location: Sequence[str | int]) -> str:
    """The dotted key of an error's location, without pydantic's tags of union members."""
    return ".".join(str(part) for part in _steps(model, location)) or "the file"


def allowed_keys(model: type[BaseModel], location: Sequence[str | int]) -> list[str]:
    """The allowed keys of the table at a location in a file or request."""
    models = [model]
    for part in location:
        models = _after(models, part)[1]
    return list(dict.fromkeys(key for each in models for key in each.model_fields))


def explained(model: type[BaseModel], fault: PydanticFault) -> str:
    """The message for an error in a file; for an unknown key with the most similar allowed key."""
    if fault["type"] != "extra_forbidden":
        return plain_message(fault)
    allowed = allowed_keys(model, fault["loc"][:-1])
    near = nearest(fault["loc"][-1], allowed)
    return (
        f"no such key; {f'did you mean {near}?' if near else 'allowed here: ' + ', '.join(allowed)}"
    )


Models = list[type[BaseModel]]


def _steps(model: type[BaseModel], location: Sequence[str | int]) -> Iterator[str | int]:
    models = [model]
    for part in location:
        is_key, models = _after(models, part)
        if is_key:
            yield part


def _after(models: Models, part: str | int) -> tuple[bool, Models]:
    """True if a part of an error's location is a key or index, and the models at that part."""
    fields = [each.model_fields[part] for each in models if part in each.model_fields]
    if fields:
        return True, [found for field in fields for found in _models_in(field.annotation)]
    tagged = [each for each in models if part in _tags(each)]
    # Below a table pydantic also names the members of a union of values.
    is_key = isinstance(part, int) or bool(models and not tagged)
    return is_key, tagged or models


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    kind = model.model_fields.get("kind")
    return () if kind is None else get_args(kind.annotation)


def _models_in(annotation: Any) -> Models:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _models_in(part)]
