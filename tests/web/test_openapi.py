"""The committed reference is the app's own, complete, and its examples are what the app answers."""

import json
import re

import pytest
from jsonschema import Draft202012Validator
from sqlalchemy import select

from service.contract.base import component_name
from service.contract.events import EVENT_DATA
from service.observations.schema import submission_from_json
from service.storage.recording.events import EVENT_KINDS
from service.storage.sql.tables import events
from service.web.app import bare_app, openapi_yaml
from service.web.examples import fresh_walk, keep_recorded
from service.web.openapi import examples
from tests.web.conformance import FILE, reference, validator

OPERATIONS = [
    (path, method, operation)
    for path, methods in reference()["paths"].items()
    for method, operation in methods.items()
]
NAMED = [operation["operationId"] for _, _, operation in OPERATIONS]


def test_the_committed_file_is_what_the_app_says_of_itself(client):
    assert FILE.read_text(encoding="utf-8") == openapi_yaml(), "run: make openapi"
    assert client.get("/api/v1/openapi.json").json() == reference()


@pytest.mark.slow
def test_it_is_made_the_same_twice():
    assert openapi_yaml() == openapi_yaml()


def test_every_route_is_described():
    routes = {
        (route.path, method.lower())
        for route in bare_app().state.routes
        for method in route.methods
        if route.include_in_schema
    }
    assert {(path, method) for path, method, _ in OPERATIONS} == routes
    assert len(set(NAMED)) == len(NAMED)


def test_every_subject_is_described():
    """A page or a client that lists operations by subject would leave out the others."""
    described = {each["name"] for each in reference()["tags"]}
    assert described == {tag for _, _, operation in OPERATIONS for tag in operation["tags"]}


def test_every_reference_leads_somewhere():
    def walk(node):
        if isinstance(node, dict):
            if "$ref" in node:
                place = reference()
                for step in node["$ref"].removeprefix("#/").split("/"):
                    place = place[step]
            for each in node.values():
                walk(each)
        elif isinstance(node, list):
            for each in node:
                walk(each)

    walk(reference())


@pytest.mark.parametrize("name", reference()["components"]["schemas"])
def test_every_schema_is_one(name):
    Draft202012Validator.check_schema(reference()["components"]["schemas"][name])


def test_every_schema_has_a_name_of_its_own():
    """Generators call a class after the title; of two with the same one they drop the second."""
    schemas = reference()["components"]["schemas"]
    for name, schema in schemas.items():
        assert schema.get("title", name) == name
        # No path of a module, which is put there where two classes have one name.
        assert re.fullmatch("[A-Z][A-Za-z0-9]*", name)
    assert len({name.lower() for name in schemas}) == len(schemas)


BINARY = "application/octet-stream"
KEPT = ("application/json", BINARY)
"""The media types of bodies that every generator knows."""


@pytest.mark.parametrize(("path", "method", "operation"), OPERATIONS, ids=NAMED)
def test_a_generated_client_can_send_and_read_every_body(path, method, operation):
    """One media type at least is known to generators; what is no text and no JSON is binary."""
    parts = [operation["requestBody"]] if "requestBody" in operation else []
    parts += [each for each in operation["responses"].values() if each["content"]]
    for part in parts:
        kinds = part["content"]
        assert any(
            kind in KEPT or kind.endswith("+json") or kind.startswith("text/") for kind in kinds
        ), list(kinds)
        for kind, content in kinds.items():
            if not kind.endswith("json") and not kind.startswith("text/"):
                assert content["schema"]["type"] == "string"
                assert content["schema"]["format"] == "binary"
    if "requestBody" in operation:
        assert set(operation["requestBody"]["content"]) & set(KEPT)


@pytest.mark.parametrize(("path", "method", "operation"), OPERATIONS, ids=NAMED)
def test_every_answer_is_described_with_a_shape(path, method, operation):
    assert operation["summary"]
    assert operation["tags"]
    assert {"422", "default"} <= set(operation["responses"])
    for response in operation["responses"].values():
        assert response["description"]
        for content in response["content"].values():
            assert content["schema"]
    for parameter in operation.get("parameters", []):
        assert parameter["description"], parameter["name"]


@pytest.mark.parametrize(("path", "method", "operation"), OPERATIONS, ids=NAMED)
def test_every_example_has_the_shape_it_is_an_example_of(path, method, operation):
    parts = [("requestBody", operation["requestBody"])] if "requestBody" in operation else []
    parts += [(f"responses {status}", each) for status, each in operation["responses"].items()]
    for where, part in parts:
        for kind, content in part["content"].items():
            check = validator("paths", path, method, *where.split(), "content", kind, "schema")
            for example in content.get("examples", {}).values():
                if kind.endswith("json"):
                    check.validate(example["value"])


def test_the_documents_show_an_event_of_each_kind_as_it_is_described():
    text = (FILE.parent / "docs" / "api.md").read_text(encoding="utf-8")
    shown = json.loads(re.search(r"```json\n(\{\"batches\".*?)```", text, re.DOTALL)[1])
    assert set(shown) == set(EVENT_KINDS) == set(reference()["webhooks"])
    for kind, data in shown.items():
        content = reference()["webhooks"][kind]["post"]["requestBody"]["content"]
        component = content["application/json"]["schema"]["properties"]["data"]["$ref"]
        validator("components", "schemas", component.rpartition("/")[2]).validate(data)


def test_events_as_they_are_recorded_are_as_described(app, client, post, batch):
    """Those of every kind that the tests before this one gave rise to, too."""
    post(batch | {"batch": "for-its-event"})
    client.post("/api/v1/annotations", json={"text": "x", "start": batch["time"], "who": "jb"})
    client.put(
        "/api/v1/spacecraft/XTE/limits/silence_s",
        json={"settings": {"enabled": False}, "who": "jb"},
    ).raise_for_status()
    with app.context.reading() as connection:
        rows = connection.execute(select(events.c.kind, events.c.data)).all()
    assert {"batches", "annotation", "limit"} <= {row.kind for row in rows}
    for kind, data in rows:
        component = component_name(EVENT_DATA[kind])
        validator("components", "schemas", component).validate(json.loads(data))


def test_every_batch_among_the_examples_can_be_sent():
    for batch in examples()["submit_batch"]["request"].values():
        assert submission_from_json(json.dumps(batch))


def test_every_route_that_answers_json_has_examples_of_its_success():
    for _, _, operation in OPERATIONS:
        kinds = {kind for each in operation["responses"].values() for kind in each["content"]}
        if "application/json" in kinds:
            assert set(examples()[operation["operationId"]]) & {"200", "201", "202"}


def test_the_examples_are_what_the_app_still_answers():
    """Numbers that differ from run to run aside."""
    found = fresh_walk()
    assert shape(found) == shape(examples()), "run: python -m service.web.examples && make openapi"


def test_new_examples_keep_ids_times_and_durations():
    recorded = {"id": "a", "stars": 3, "many": [{"at": 1}], "timings_us": {"zone": 7}}
    walked = {"id": "b", "stars": 4, "many": [{"at": 2}], "timings_us": {"zone": 5}, "new": "n"}
    again = {"id": "c", "stars": 4, "many": [{"at": 3}], "timings_us": {"zone": 5}, "new": "m"}
    kept = keep_recorded(walked, again, recorded)
    assert kept == recorded | {"stars": 4, "new": "n"}


def shape(value):
    if isinstance(value, dict):
        return {key: shape(each) for key, each in value.items()}
    if isinstance(value, list):
        return [shape(each) for each in value]
    return value if isinstance(value, bool) else type(value).__name__
