"""Whatever is sent: an answer as described, and never a fault of ours."""

import copy
import json
import string
from urllib.parse import quote

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.scale import draws
from tests.web.conformance import reference

URL = "/api/v1/batches"
JSON = {"Content-Type": "application/json"}

many = settings(
    max_examples=draws(30, 150),
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)

odd_text = st.one_of(
    st.text(max_size=20),
    st.sampled_from(["\0", "\ud800", "\u2028", "a" * 300, "NaN", "1e999", "", " ", "../..", "💫"]),
)
odd_number = st.one_of(
    st.integers(),
    st.floats(),
    st.sampled_from([10**400, -(10**18), 2**63, 1e308, 5e-324, -0.0, True]),
)
odd_value = st.recursive(
    st.one_of(st.none(), odd_number, odd_text),
    lambda inner: st.one_of(
        st.lists(inner, max_size=5), st.dictionaries(odd_text, inner, max_size=4)
    ),
    max_leaves=8,
)


def places(value, way=()):
    """Every place in a JSON value, as the way that leads to it."""
    yield way
    steps = ()
    if isinstance(value, dict):
        steps = value.items()
    elif isinstance(value, list):
        steps = enumerate(value)
    for step, inner in steps:
        yield from places(inner, (*way, step))


def put(value, way, new):
    if not way:
        return new
    other = copy.deepcopy(value)
    place = other
    for step in way[:-1]:
        place = place[step]
    place[way[-1]] = new
    return other


@many
@given(data=st.data())
def test_any_value_in_any_place_of_a_batch(client, drawn, data):
    batch = drawn("XTE", 1)[0] | {"run": "fuzz", "options": {"tests": {}, "tolerances": {}}}
    way = data.draw(st.sampled_from(list(places(batch))))
    body = json.dumps(put(batch, way, data.draw(odd_value)))
    assert client.post(URL, content=body, headers=JSON).status_code < 500


@many
@given(data=st.data())
def test_any_bytes_in_the_middle_of_a_batch(client, drawn, data):
    body = json.dumps(drawn("XTE", 1)[0] | {"run": "fuzz"}).encode()
    start = data.draw(st.integers(0, len(body)))
    end = data.draw(st.integers(start, min(len(body), start + 30)))
    body = body[:start] + data.draw(st.binary(max_size=30)) + body[end:]
    assert client.post(URL, content=body, headers=JSON).status_code < 500


@many
@given(body=st.one_of(odd_value.map(json.dumps), st.binary(max_size=200)))
def test_any_body_of_any_route_that_takes_one(client, body):
    for path, methods in reference()["paths"].items():
        if "requestBody" in methods.get("post", {}):
            url = path.replace("{id}", "01JD0000000000000000000000")
            assert client.post(url, content=body, headers=JSON).status_code < 500


STREAM = "/api/v1/events"
"""Its answer has no end; `test_events` asks it."""
QUERIED = [
    (path, parameter["name"])
    for path, methods in reference()["paths"].items()
    for parameter in methods.get("get", {}).get("parameters", [])
    if parameter["in"] == "query" and path != STREAM
]


@many
@given(where=st.sampled_from(QUERIED), value=st.one_of(odd_text, st.text(string.printable)))
def test_any_query(client, where, value):
    path, name = where
    value = value.encode("utf-8", "surrogatepass")
    answer = client.get(f"{path.replace('{name}', 'XTE')}?{name}={quote(value)}")
    assert answer.status_code < 500


@many
@given(name=odd_text)
def test_any_name_in_a_path(client, name):
    name = quote(name.encode("utf-8", "surrogatepass"), safe="")
    for path in reference()["paths"]:
        if "{" in path:
            url = path.replace("{id}", name).replace("{name}", name)
            assert client.get(url).status_code < 500
