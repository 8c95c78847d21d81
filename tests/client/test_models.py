"""Models and methods are those of openapi.yaml: fields, types, and whether one may be absent."""

import ast
import inspect
import json
import re
from pathlib import Path
from typing import Annotated, ClassVar, Literal, get_args, get_type_hints

import acquire_client as client
import generate
import msgspec
import pytest
from acquire_client import event_lines, models, words
from msgspec import UNSET, UnsetType

from service.contract.base import Absent, Components, Count, Moment, Record, component_name, doc
from service.web.openapi import ClientMethod
from tests.web.conformance import FILE, reference

SCHEMAS = reference()["components"]["schemas"]
NAMES = {
    generate.client_name(record): component_name(record)
    for record in generate.all_records().values()
    if component_name(record) in SCHEMAS
}
"""The name of each model's schema."""
MODELS = {
    NAMES[name]: model
    for name, model in inspect.getmembers(models, inspect.isclass)
    # A base, or an answer whose id is known, has no schema of its own.
    if name in NAMES
}


def shape(schema, schemas, name_of):
    """What a value may be, as a set of words and pairs; enumerations and bounds are left out."""
    if "anyOf" in schema:
        return frozenset().union(*(shape(each, schemas, name_of) for each in schema["anyOf"]))
    if "$ref" in schema:
        name = name_of(schema["$ref"].rpartition("/")[2])
        if name in MODELS:
            return frozenset([name])
        # Free settings, which the client passes on as they are.
        return shape(schemas[schema["$ref"].rpartition("/")[2]], schemas, name_of)
    kind = schema.get("type")
    if kind == "array":
        return frozenset([("array", shape(schema["items"], schemas, name_of))])
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        values = shape(schema["additionalProperties"], schemas, name_of)
        # Quantities come by their names, which the document lists and the client does not.
        return frozenset(["object" if values <= {"number", "null"} else ("object", values)])
    return frozenset([kind])


def test_every_model_is_a_schema_or_the_base_of_one():
    kinds = dict(inspect.getmembers(models, inspect.isclass))
    assert len(MODELS) > 80
    assert kinds.keys() - NAMES.keys() == {"Answer", "CalibrationProgress"}


@pytest.mark.parametrize("name", MODELS)
def test_a_model_has_the_fields_of_its_schema_with_their_types(name):
    _, components = msgspec.json.schema_components([MODELS[name]], ref_template="#/{name}")
    own = components[MODELS[name].__name__]
    theirs = SCHEMAS[name]
    assert set(own["properties"]) == set(theirs["properties"])
    assert set(own.get("required", [])) == set(theirs["required"])
    for field, schema in theirs["properties"].items():
        here = shape(own["properties"][field], components, lambda each: NAMES.get(each, "Answer"))
        there = shape(schema, SCHEMAS, lambda each: each)
        # A field that may be absent is None then.
        absent = set() if field in theirs["required"] else {"null"}
        assert here - absent == there - absent, field


def test_each_kind_of_event_has_the_model_of_its_data():
    """Those of the webhooks that openapi.yaml describes, and the example of each in api.md."""
    text = (FILE.parent / "docs" / "api.md").read_text(encoding="utf-8")
    shown = json.loads(re.search(r"```json\n(\{\"batches\".*?)```", text, re.DOTALL)[1])
    described = reference()["webhooks"]
    assert event_lines._BY_KIND.keys() == described.keys()
    for kind, webhook in described.items():
        content = webhook["post"]["requestBody"]["content"]["application/json"]["schema"]
        schema = content["properties"]["data"]["$ref"].rpartition("/")[2]
        data = get_type_hints(event_lines._BY_KIND[kind])["data"]
        assert NAMES[data.__name__] == schema
        event = event_lines.Block(7, kind, json.dumps(shown[kind])).event()
        assert (event.id, event.kind, type(event.data)) == (7, kind, data)


@pytest.mark.parametrize("package", [client, models])
def test_every_name_is_public_for_a_type_checker(package):
    """It takes only `X as X` for such a name; without `__all__` none stands twice."""
    lines = ast.parse(Path(package.__file__).read_text(encoding="utf-8")).body
    imported = [each for line in lines if isinstance(line, ast.ImportFrom) for each in line.names]
    assert len(imported) > 30
    assert [each.name for each in imported if each.asname != each.name] == []


def test_an_event_of_a_later_service_is_handed_out_with_its_word():
    event = event_lines.Block(7, "eclipse", '{"begins": 3}').event()
    assert event == client.OtherEvent(7, "other", "eclipse", {"begins": 3})
    with pytest.raises(client.UnexpectedAnswer, match="this is no event of the service"):
        event_lines.Block(7, "batches", '{"run": 3}').event()


def test_words_are_those_of_the_schemas():
    for word, (schema, field) in {
        words.OutcomeWord: ("StarOut", "outcome"),
        words.StatusWord: ("AttitudeOut", "status"),
        words.IdentifierWord: ("Answer", "identifier"),
    }.items():
        assert set(get_args(word)) == set(SCHEMAS[schema]["properties"][field]["enum"])
    # A word of a later service is read all the same.
    star = {"outcome": "doubtful", "star": None, "votes": 0, "runner_up": 0, "flags": []}
    star |= {"probability": None, "residual_arcsec": None}
    assert msgspec.convert(star, models.Star).outcome == "doubtful"


def test_an_answer_is_a_what_if_that_was_recorded():
    answer, what_if = (get_type_hints(each) for each in (models.Answer, models.WhatIf))
    assert answer == what_if | {"id": str}


def test_what_a_later_service_adds_is_ignored():
    page = b'{"run": "a", "alarms": true, "added": {"later": [1]}}'
    assert msgspec.json.decode(page, type=models.RunState) == models.RunState(run="a", alarms=True)


class Dwell(Record, frozen=True, kw_only=True):
    """A dwell of an axis; null where it goes on."""

    component: ClassVar[str] = ""
    client_name: ClassVar[str] = "AxisDwell"
    start: Moment
    end: Annotated[Moment | None, doc("null: it goes on.")]
    state: Literal["slow", "still"]
    parts: list[Components] | UnsetType = UNSET
    settled: Annotated[bool | UnsetType, Absent(True)] = UNSET
    """Whatever is not
    known."""
    note: str | UnsetType = UNSET
    count: Count = 0


def test_a_record_of_any_package_becomes_a_model():
    """Records of features from elsewhere are found by the entry point `acquire.features`."""
    text = generate.class_text(Dwell)
    assert (
        text.strip()
        == '''class AxisDwell(Model, frozen=True, kw_only=True):
    """A dwell of an axis; None where it goes on."""

    start: str
    end: str | None
    """None: it goes on."""
    state: str
    parts: Sequence[Sequence[float]] = ()
    settled: bool = True
    """Whatever is not known."""
    note: str | None = None
    count: int = 0'''
    )


def test_a_route_of_any_package_becomes_a_method():
    """From its description alone: names, types, defaults and texts."""
    run = {"name": "run", "in": "query", "required": False, "description": "null: every run."}
    operation = {
        "summary": "Dwells of an axis.\n\nThe longest first",
        "parameters": [
            {"name": "name", "in": "path", "required": True, "schema": {"type": "string"}},
            run | {"schema": {"anyOf": [{"type": "string"}, {"type": "null"}]}},
            {
                "name": "axes",
                "in": "query",
                "required": True,
                "schema": {"type": "array", "items": {"type": "integer"}},
            },
        ],
        "responses": {
            "200": {"content": {generate.JSON: {"schema": {"$ref": "#/components/schemas/Dwell"}}}}
        },
    }
    method = ClientMethod("dwells", by_place=("axes",), example=">>> 1 + 1\n2")
    path = "/api/v1/spacecraft/{name}/dwells"
    text = generate.method_text(method, path, "get", operation, {}, {"Dwell": Dwell})
    assert (
        generate.tidied(text.replace("\n    ", "\n").strip(), Path("dwells.py"))
        == '''@single_request
def dwells(
    self, spacecraft: str, axes: Sequence[int], *, run: str | None = None
) -> Call[models.AxisDwell]:
    """Dwells of an axis.

    The longest first.

    - `run`: None: every run.

    >>> 1 + 1
    2
    """
    path = path_of("spacecraft", spacecraft, "dwells")
    query = {"axes": axes, "run": run}
    return Call(model(models.AxisDwell), "GET", path, query=query)
'''
    )
