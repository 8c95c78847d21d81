"""Tests of `make compare`: permitted differences of two versions, and detected ones."""

import copy
import json

import pytest

from benchmarks.compare.__main__ import NO_ANSWER, Outcome, Tally
from benchmarks.compare.answers import (
    MISSING,
    Difference,
    Names,
    Plain,
    Received,
    differences,
    metrics,
    problem,
)
from benchmarks.compare.inputs import Request, phases_of, write_twin
from benchmarks.compare.interface import NOTHING, interface_differences
from benchmarks.compare.servers import HERE

ONE, TWO, THREE = (f"01KB{'0' * 21}{k}" for k in range(3))
ANSWER = {
    "id": ONE,
    "parent": None,
    "spacecraft": "XTE",
    "time": "1999-03-01T00:00:00.000Z",
    "created": "2026-11-23T06:00:00.000Z",
    "counts": {"unique": 3, "ambiguous": 0},
    "observations": [{"zone": {"cached": False}, "stars": [{"probability": 0.9991}]}],
    "attitude": {"quaternion": [0.1, 0.2, 0.3, 0.927361849]},
    "warnings": ["attitude_suspect: taste 41.2 is above 18.5"],
    "timings_us": {"zone": 12, "record": 40},
    "provenance": {"version": "0.1.0", "mission": "sha256:1"},
    "next_cursor": None,
}


def found(change, cached_counts=True, first=ANSWER):
    """Paths of the differences between an answer and its changed copy."""
    second = copy.deepcopy(first)
    change(second)
    plain = [
        Plain(Names()).answer(
            Received(200, {"content-type": "application/json"}, json.dumps(each).encode()),
            "one",
            cached_counts,
        )
        for each in (first, second)
    ]
    return [each.path for each in differences(*plain)]


# ---- answers -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda answer: answer.update(id=TWO),
        lambda answer: answer.update(created="2027-01-01T00:00:00.000Z"),
        lambda answer: answer["timings_us"].update(zone=99, record=1),
        lambda answer: answer["provenance"].update(version="0.2.0"),
        lambda answer: answer.update(warnings=["attitude_suspect: in other words"]),
    ],
    ids=["id", "stamp", "durations", "version", "text of a warning"],
)
def test_what_differs_between_equal_runs_is_let_pass(change):
    assert found(change) == []


@pytest.mark.parametrize(
    ("change", "path"),
    [
        (lambda a: a.update(spacecraft="SWAS"), "body.spacecraft"),
        (lambda a: a.update(time="1999-03-01T00:00:00.001Z"), "body.time"),
        (lambda a: a["counts"].update(unique=4), "body.counts.unique"),
        (lambda a: a["counts"].update(unique=3.0), "body.counts.unique"),
        (lambda a: a["counts"].pop("unique"), "body.counts.unique"),
        (lambda a: a["counts"].update(more=1), "body.counts.more"),
        (
            lambda a: a["attitude"]["quaternion"].__setitem__(3, 0.9273618490000001),
            "body.attitude.quaternion.3",
        ),
        (lambda a: a["attitude"]["quaternion"].pop(), "body.attitude.quaternion.length"),
        (lambda a: a.update(attitude=None), "body.attitude"),
        (lambda a: a.update(warnings=["mirrored_field: x"]), "body.warnings.0"),
        (lambda a: a.update(warnings=[]), "body.warnings.length"),
        (lambda a: a.update(id=None), "body.id"),
        (lambda a: a.update(parent=ONE), "body.parent"),
        (lambda a: a.update(created=None), "body.created"),
        (lambda a: a["timings_us"].update(record=None), "body.timings_us.record"),
        (lambda a: a["timings_us"].pop("record"), "body.timings_us.record"),
        (lambda a: a["provenance"].update(mission="sha256:2"), "body.provenance.mission"),
        (lambda a: a.update(next_cursor="x"), "body.next_cursor"),
        (
            lambda a: a["observations"][0]["zone"].update(cached=True),
            "body.observations.0.zone.cached",
        ),
        (
            lambda a: a["observations"][0]["stars"][0].update(probability=0.9992),
            "body.observations.0.stars.0.probability",
        ),
    ],
)
def test_everything_else_is_found(change, path):
    assert path in found(change)


def test_where_requests_overlap_the_cache_does_not_count():
    def cached(answer):
        answer["observations"][0]["zone"]["cached"] = True

    assert found(cached, cached_counts=False) == []
    assert found(lambda answer: answer.update(attitude=None), cached_counts=False)


def test_a_cursor_may_be_another_but_not_missing():
    first = ANSWER | {"next_cursor": "abc"}
    assert found(lambda answer: answer.update(next_cursor="def"), first=first) == []
    assert found(lambda answer: answer.update(next_cursor=None), first=first)


def test_means_may_differ_as_sums_in_another_order_do():
    def shown(mean):
        other = {"series": {"taste": {"mean": [mean, None], "max": [mean]}}, "taste_mean": mean}
        table = b"taste_mean\n%r\n" % mean
        plain = Plain(Names())
        rows = plain.answer(Received(200, {"content-type": "text/csv"}, table), "table")
        return [plain.value(other, "one"), rows]

    def paths(mean):
        return [each.path for each in differences(shown(2.479429682429297), shown(mean))]

    assert paths(2.4794296824292976) == [".0.series.taste.max.0"]
    assert len(paths(2.4794296)) == 4


def test_a_reference_to_another_record_is_found():
    """Each server makes new ids, but they must name the same records."""
    shown = []
    for first, second, refers_to in ((ONE, TWO, ONE), (TWO, THREE, THREE)):
        plain = Plain(Names())
        plain.value({"id": first}, "first")
        plain.value({"id": second}, "second")
        shown.append(plain.value({"parent": refers_to, "about": f"/x/{refers_to}/y"}, "third"))
    assert [each.path for each in differences(*shown)] == ["parent", "about"]


def test_ids_of_one_answer_have_names_of_their_own():
    plain = Plain(Names())
    shown = plain.value({"items": [{"id": ONE}, {"id": TWO}, {"id": ONE}]}, "list")["items"]
    assert shown[0] == shown[2] != shown[1]


def test_of_a_problem_status_type_and_fields_count():
    given = {
        "type": "/problems/bad-input",
        "title": "The input is refused",
        "status": 422,
        "detail": "time: must be UTC",
        "instance": "/api/v1/batches",
        "errors": [{"field": "time", "message": "must be UTC", "value": "noon"}],
    }
    other = given | {"title": "Invalid input", "detail": "x", "instance": "y"}
    other |= {"errors": [{"field": "time", "message": "z", "value": None}]}
    assert problem(given) == problem(other)
    assert problem(given) != problem(given | {"type": "/problems/conflict"})
    assert problem(given) != problem(given | {"status": 400})
    assert problem(given) != problem(given | {"errors": []})
    assert problem(given) != problem(given | {"errors": [{"field": "run"}]})


def test_status_and_headers_count():
    def shown(status, **headers):
        received = Received(status, {"content-type": "application/json", **headers}, b"{}")
        return Plain(Names()).answer(received, "one")

    assert list(differences(shown(200), shown(201)))
    assert list(differences(shown(200), shown(200, replayed="true")))
    assert list(differences(shown(200), shown(200, link="<a>")))
    assert not list(differences(shown(200, link="<a>"), shown(200, link="<b>")))
    assert not list(differences(shown(200), shown(200, server="another")))


def test_bodies_that_are_no_json_are_compared():
    def shown(kind, body):
        return Plain(Names()).answer(Received(200, {"content-type": kind}, body), "one")

    assert list(differences(shown("image/png", b"a"), shown("image/png", b"b")))
    table = b"id,time,received,taste\n%s,1999,2026,1.0\n"
    one, other = table % ONE.encode(), table.replace(b"2026", b"2027") % TWO.encode()
    assert not list(differences(shown("text/csv", one), shown("text/csv", other)))
    other = other.replace(b"1.0", b"1.1")
    assert [each.path for each in differences(shown("text/csv", one), shown("text/csv", other))]


def test_of_metrics_names_labels_and_counts_of_answers_count():
    text = 'a_seconds{route="/x",le="1"} 5\nstarid_stars_total{outcome="unique"} 7\n'
    assert metrics(text) == metrics(text.replace("5", "6"))
    assert metrics(text) == metrics(text.replace("/x", "/y"))
    assert metrics(text) != metrics(text.replace("7", "8"))
    assert metrics(text) != metrics(text.replace("route", "path"))
    assert metrics(text) != metrics(text.replace("a_seconds", "b_seconds"))


def test_what_the_base_does_not_have_is_an_addition():
    one, other = differences({"a": 1, "b": 2}, {"b": 3, "c": 4, "a": 1})
    assert (one, one.is_addition) == (Difference("b", 2, 3), False)
    assert (other.path, other.is_addition) == ("c", True)


@pytest.mark.parametrize(
    ("statuses", "found", "allow_additions", "counted"),
    [
        ((200, 200), [], False, 0),
        ((200, 200), [Difference("body.a", 1, 2)], False, 1),
        ((200, 200), [Difference("body.a", MISSING, 2)], False, 1),
        ((200, 200), [Difference("body.a", MISSING, 2)], True, 0),
        ((200, 200), [Difference("body.a", 1, MISSING)], True, 1),
        ((NO_ANSWER, NO_ANSWER), [], False, 1),
    ],
)
def test_differences_are_counted_and_kept_for_a_repeat(
    tmp_path, statuses, found, allow_additions, counted
):
    """The count includes requests that neither server answered, since nothing was compared."""
    tally = Tally(tmp_path, allow_additions)
    request = Request("batch", "batch-1", "POST", "/x", b"\xff")
    received = tuple(Received(status, {}, b"late") for status in statuses)
    tally.add(Outcome(request, ("/x", "/x"), received, found))
    assert tally.differ.total() == counted
    assert tally.counts.total() == 1
    assert len(list(tmp_path.iterdir())) == counted
    if counted:
        assert json.loads((tmp_path / "batch-1.json").read_text())["content_base64"] == "/w=="


# ---- the interface -------------------------------------------------------------------------------

INTERFACE = {
    "openapi": "3.1.0",
    "info": {"title": "Attitude acquisition", "version": "0.1.0", "description": "x"},
    "paths": {
        "/a": {
            "get": {
                "operationId": "get_a",
                "summary": "A",
                "security": [{"token": ["read"]}],
                "parameters": [
                    {"name": "limit", "in": "query", "schema": {"type": "integer", "default": 5}}
                ],
                "responses": {"200": {"description": "x", "content": {"application/json": {}}}},
            },
            "post": {
                "operationId": "post_a",
                "requestBody": {
                    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/In"}}}
                },
                "responses": {"201": {"description": "x"}},
            },
        }
    },
    "components": {
        "schemas": {
            "In": {
                "type": "object",
                "properties": {"title": {"type": "string", "pattern": "^a", "description": "x"}},
                "required": ["title"],
            },
            "Out": {
                "type": "object",
                "title": "Out",
                "properties": {
                    "title": {"type": ["string", "null"], "examples": ["x"]},
                    "kind": {"enum": ["a", "b"], "default": "a"},
                },
                "required": ["title", "kind"],
            },
        }
    },
}
SCHEMAS = "components/schemas"


def changed(change):
    """Differences found after a change of the interface: additions, and other differences."""
    other = copy.deepcopy(INTERFACE)
    change(other)
    every = interface_differences(INTERFACE, other)
    return (
        [each.path for each in every if each.is_addition],
        [each.path for each in every if not each.is_addition],
    )


def schema(document, name):
    return document["components"]["schemas"][name]


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["info"].update(title="y", description="y", version="2"),
        lambda d: d["paths"]["/a"]["get"].update(summary="B", description="y"),
        lambda d: d["paths"]["/a"]["get"]["responses"]["200"].update(description="y"),
        lambda d: schema(d, "In")["properties"]["title"].update(description="y", title="z"),
        lambda d: schema(d, "Out")["properties"]["title"].pop("examples"),
        lambda d: schema(d, "Out").update(title="Something", required=["kind", "title"]),
        lambda d: schema(d, "Out")["properties"]["kind"].update(enum=["b", "a"]),
        lambda d: schema(d, "In").update(type=["object"]),
    ],
)
def test_prose_and_order_may_change(change):
    assert changed(change) == ([], [])


@pytest.mark.parametrize(
    ("change", "path"),
    [
        (lambda d: d["paths"]["/a"]["get"].update(operationId="a"), "paths/~/get/operationId"),
        (lambda d: d["paths"]["/a"].pop("get"), "paths/~/get"),
        (lambda d: d["paths"].update({"/b": d["paths"].pop("/a")}), "paths/~"),
        (
            lambda d: d["paths"]["/a"]["get"].update(security=[{"token": ["operate"]}]),
            "paths/~/get/security/0/token/0",
        ),
        (
            lambda d: d["paths"]["/a"]["get"]["parameters"][0]["schema"].update(default=6),
            "paths/~/get/parameters/query limit/schema/default/is",
        ),
        (lambda d: d["paths"]["/a"]["get"]["responses"].pop("200"), "paths/~/get/responses/200"),
        (lambda d: schema(d, "In")["properties"].pop("title"), f"{SCHEMAS}/In/properties/title"),
        (
            lambda d: schema(d, "In")["properties"]["title"].update(pattern="^b"),
            f"{SCHEMAS}/In/properties/title/pattern",
        ),
        (
            lambda d: schema(d, "In")["properties"]["title"].update(maxLength=3),
            f"{SCHEMAS}/In/properties/title/maxLength",
        ),
        (
            lambda d: schema(d, "Out")["properties"]["title"].update(type="string"),
            f"{SCHEMAS}/Out/properties/title/type/null",
        ),
        (
            lambda d: schema(d, "Out")["properties"]["kind"].update(enum=["a"]),
            f"{SCHEMAS}/Out/properties/kind/enum/b",
        ),
        (
            lambda d: schema(d, "Out")["properties"]["kind"].update(default="b"),
            f"{SCHEMAS}/Out/properties/kind/default/is",
        ),
        (lambda d: schema(d, "Out").update(required=["title"]), f"{SCHEMAS}/Out/required/kind"),
        (
            lambda d: d["components"]["schemas"].update(
                Answer=d["components"]["schemas"].pop("Out")
            ),
            f"{SCHEMAS}/Out",
        ),
    ],
)
def test_what_a_client_relies_on_may_not_change(change, path):
    assert path.replace("~", "/a") in changed(change)[1]


@pytest.mark.parametrize(
    ("change", "path"),
    [
        (lambda d: d["paths"].update({"/b": {"get": {}}}), "paths//b"),
        (lambda d: d["paths"]["/a"].update(delete={}), "paths//a/delete"),
        (
            lambda d: schema(d, "In")["properties"].update(more={"type": "string"}),
            f"{SCHEMAS}/In/properties/more",
        ),
        (
            lambda d: d["paths"]["/a"]["get"]["parameters"].append({"name": "x", "in": "query"}),
            "paths//a/get/parameters/query x",
        ),
        (
            lambda d: schema(d, "Out")["properties"]["kind"]["enum"].append("c"),
            f"{SCHEMAS}/Out/properties/kind/enum/c",
        ),
    ],
)
def test_additions_are_told_apart(change, path):
    assert changed(change) == ([path], [])


def test_a_new_field_of_an_answer_may_be_always_there_but_one_of_a_request_not():
    def always(name):
        def change(document):
            schema(document, name)["properties"]["more"] = {"type": "string"}
            schema(document, name)["required"].append("more")

        return changed(change)

    assert always("Out") == ([f"{SCHEMAS}/Out/properties/more"], [])
    assert always("In") == ([f"{SCHEMAS}/In/properties/more"], [f"{SCHEMAS}/In/required/more"])


def test_a_parameter_that_must_be_given_is_no_addition():
    asked = {"name": "x", "in": "query", "required": True}
    additions, others = changed(lambda d: d["paths"]["/a"]["get"]["parameters"].append(asked))
    assert (additions, others) == ([], ["paths//a/get/parameters/query x"])
    other = copy.deepcopy(INTERFACE)
    other["paths"]["/a"]["get"]["parameters"].append(asked)
    assert interface_differences(INTERFACE, other)[0].base == NOTHING


# ---- the inputs ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_seed_draws_the_same_inputs_and_every_name_once(tmp_path):
    write_twin(tmp_path, HERE)
    one, again = (phases_of(60, 3, tmp_path) for _ in range(2))
    assert one == again
    names = [request.name for phase in one for request in phase.requests]
    assert len(set(names)) == len(names)
