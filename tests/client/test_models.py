"""The models are those of openapi.yaml: every field, its type, and whether it may be absent."""

import inspect
import json
import re
from typing import get_args, get_type_hints

import acquire_client as client
import msgspec
import pytest
from acquire_client import base, errors, event_lines, models
from acquire_client.base import FieldFault, Model

from tests.web.conformance import FILE, reference

SCHEMAS = reference()["components"]["schemas"]
NAMES = {
    "Acted": "ActedOut",
    "Adopted": "AdoptedEvent",
    "Alarm": "AlarmOut",
    "AlarmAction": "ActionOut",
    "AlarmRaised": "RaisedOut",
    "AlarmValue": "PointOut",
    "AlarmWithActions": "AlarmRecord",
    "AnnotationChange": "AnnotationEvent",
    "Attitude": "AttitudeOut",
    "CalibrationChange": "CalibrationEvent",
    "Detection": "DetectionOut",
    "FieldFault": "FaultOut",
    "FrameSummary": "FrameOut",
    "FrameTimings": "FrameTimingsOut",
    "FrameWithStars": "FrameRecordOut",
    "Limit": "LimitOut",
    "ProblemDocument": "Problem",
    "Provenance": "ProvenanceOut",
    "RankedBatch": "WorstBatch",
    "Ranking": "WorstList",
    "Recorded": "BatchesEvent",
    "Replay": "ReplayState",
    "ReplayProgress": "ReplayEvent",
    "Result": "Record",
    "Rival": "RivalOut",
    "Run": "RunRow",
    "SearchedZone": "ZoneOut",
    "Shelved": "ShelfOut",
    "Star": "StarOut",
    "StarCounts": "CountsOut",
    "Timings": "TimingsOut",
    "Track": "TrackOut",
    "TrackerFit": "TrackerFitOut",
    "TrackerStars": "TrackerOut",
    "TrackingChange": "TrackingEvent",
    "WhatIf": "Answer",
}
"""The schemas whose names differ from those of the models."""
MODELS = {
    NAMES.get(name, name): model
    for name, model in [
        *inspect.getmembers(models, inspect.isclass),
        ("FieldFault", FieldFault),
        ("ProblemDocument", errors.ProblemDocument),
    ]
    if issubclass(model, Model)
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


def test_every_model_is_a_schema():
    assert len(MODELS) > 40
    assert [name for name in MODELS if name not in SCHEMAS] == []


@pytest.mark.parametrize("name", MODELS)
def test_a_model_has_the_fields_of_its_schema_with_their_types(name):
    _, components = msgspec.json.schema_components([MODELS[name]], ref_template="#/{name}")
    own = components[MODELS[name].__name__]
    theirs = SCHEMAS[name]
    assert set(own["properties"]) == set(theirs["properties"])
    assert set(own.get("required", [])) == set(theirs["required"])
    for field, schema in theirs["properties"].items():
        here = shape(own["properties"][field], components, lambda each: NAMES.get(each, each))
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
        assert NAMES.get(data.__name__, data.__name__) == schema
        event = event_lines.Block(7, kind, json.dumps(shown[kind])).event()
        assert (event.id, event.kind, type(event.data)) == (7, kind, data)


@pytest.mark.parametrize("package", [client, models])
def test_all_holds_every_public_name_and_no_module_but_the_models(package):
    public = [name for name, value in vars(package).items() if not inspect.ismodule(value)]
    public += ["models"] if package is client else []
    assert sorted(package.__all__) == sorted(name for name in public if name[0] != "_")


def test_an_event_of_a_later_service_is_handed_out_with_its_word():
    event = event_lines.Block(7, "eclipse", '{"begins": 3}').event()
    assert event == client.OtherEvent(7, "other", "eclipse", {"begins": 3})
    with pytest.raises(client.UnexpectedAnswer, match="this is no event of the service"):
        event_lines.Block(7, "batches", '{"run": 3}').event()


def test_words_are_those_of_the_schemas():
    for word, (schema, field) in {
        base.OutcomeWord: ("StarOut", "outcome"),
        base.StatusWord: ("AttitudeOut", "status"),
        base.IdentifierWord: ("Answer", "identifier"),
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
    assert msgspec.json.decode(page, type=models.RunState) == models.RunState("a", alarms=True)
