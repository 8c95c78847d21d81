"""Every mistake of a client: a clear answer that names field and value, never a 5xx."""

import copy
import json

import httpx
import pytest

PROBLEM = "application/problem+json"
URL = "/api/v1/batches"
NO_ID = "01JD0000000000000000000000"


def changed(batch, path, value):
    """A copy of the batch with one value put in its place; the path as in an error's field."""
    other = copy.deepcopy(batch)
    *way, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    place = other
    for step in way:
        place = place[step]
    place[last] = value
    return other


STARS = "observations.0.stars"
VECTOR = f"{STARS}.0.vector"
A_STAR = {"vector": [0.0, 0.0, 1.0], "magnitude": 5.0}

# name: (where, what stands there, the field that is named, a part of the value that is shown)
WRONG = {
    "unknown tracker": ("observations.0.tracker", "NO_SUCH", "observations.0.tracker", "NO_SUCH"),
    "no trackers": ("observations", [], "observations", "[]"),
    "no stars": (STARS, [], "observations", "stars"),
    "10,000 stars": (STARS, [A_STAR] * 10_000, STARS, "vector"),
    "a zero vector": (VECTOR, [0, 0, 0], VECTOR, "0"),
    "a vector of norm 2": (VECTOR, [0, 0, 2], VECTOR, "2"),
    "a vector of two": (VECTOR, [0, 1], VECTOR, "0, 1"),
    "NaN": (VECTOR, [float("nan"), 0, 1], f"{VECTOR}.0", "nan"),
    "an infinity": (VECTOR, [float("-inf"), 0, 1], f"{VECTOR}.0", "-inf"),
    "a number in quotes": (VECTOR, ["0", 0, 1], f"{VECTOR}.0", "0"),
    "true for a number": (VECTOR, [True, 0, 1], f"{VECTOR}.0", "True"),
    "magnitude 500": (f"{STARS}.0.magnitude", 500, f"{STARS}.0.magnitude", "500"),
    "a huge whole number": (f"{STARS}.0.magnitude", 10**400, f"{STARS}.0.magnitude", None),
    "a time offset of a day": (
        f"{STARS}.0.time_offset_s",
        86400,
        f"{STARS}.0.time_offset_s",
        "86400",
    ),
    "no time": ("time", None, "time", "None"),
    "a day that does not exist": ("time", "1996-02-30T00:00:00Z", "time", "1996-02-30"),
    "a year out of range": ("time", "1066-10-14T00:00:00Z", "time", "1066"),
    "no such leap second": ("time", "1996-01-10T23:59:60Z", "time", "23:59:60"),
    "a quaternion of norm 2": ("a_priori.quaternion", [0, 0, 0, 2], "a_priori.quaternion", "2"),
    "an unknown frame": ("a_priori.frame", "B1950", "a_priori.frame", "B1950"),
    "no kind of a priori": ("a_priori", {"guess": 1}, "a_priori", "guess"),
    "sun pointed in a cap": ("a_priori", {"sun_pointed": True}, "a_priori.sun_pointed", "True"),
    "an unknown aberration": ("aberration", "maybe", "aberration", "maybe"),
    "faster than any spacecraft": (
        "velocity_km_per_s",
        [3e5, 0, 0],
        "velocity_km_per_s.0",
        "300000",
    ),
    "an unknown field": ("colour", "red", "colour", "red"),
    "a run with a slash": ("run", "a/b", "run", "a/b"),
    "an empty batch id": ("batch", "", "batch", "''"),
    "a NUL in a name": ("batch", "a\0b", "batch", "\\x00"),
    "an endless batch id": ("batch", "x" * 10_000, "batch", "xxx"),
    "a list for a name": ("spacecraft", ["XTE"], "spacecraft", "['XTE']"),
    "an unknown identifier": ("options", {"identifier": "guess"}, "options.identifier", "guess"),
    "a negative tolerance": (
        "options",
        {"tolerances": {"separation_deg": -1}},
        "options.tolerances.separation_deg",
        "-1",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_value_is_named_with_its_field(post, batch, client, run, name):
    path, value, field, shown = WRONG[name]
    answer = post(changed(batch | {"run": run}, path, value))
    assert answer.status_code == 422, answer.text
    assert answer.headers["content-type"] == PROBLEM
    named = {each["field"]: each["value"] for each in answer.json()["errors"]}
    assert field in named
    assert shown is None or shown in named[field]
    assert client.get(URL, params={"run": run}).json()["items"] == []


@pytest.mark.parametrize("text", ["1e999", "-1e999", "NaN", "Infinity"])
def test_numbers_that_are_none_are_refused_by_name(post, batch, text):
    body = json.dumps(changed(batch, f"{STARS}.0.magnitude", 4321)).replace("4321", text)
    answer = post(body.encode())
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == f"{STARS}.0.magnitude"


@pytest.mark.parametrize("field", ["spacecraft", "batch", "time", "a_priori", "observations"])
def test_a_missing_field_is_named(post, batch, field):
    answer = post({name: value for name, value in batch.items() if name != field})
    assert answer.status_code == 422
    assert field in {each["field"] for each in answer.json()["errors"]}


def test_an_unknown_spacecraft_is_a_fault_of_its_field_and_the_known_ones_are_named(post, batch):
    answer = post(batch | {"spacecraft": "NOPE"})
    assert answer.status_code == 422
    (fault,) = answer.json()["errors"]
    assert (fault["field"], fault["value"]) == ("spacecraft", "'NOPE'")
    assert "XTE" in fault["message"]


def test_all_faults_are_told_at_once(post, batch):
    answer = post(batch | {"time": "noon", "aberration": "maybe", "colour": "red"})
    assert {each["field"] for each in answer.json()["errors"]} == {"time", "aberration", "colour"}


NO_JSON = {
    "empty": b"",
    "truncated": b'{"spacecraft": "XTE", "batch"',
    "two objects": b"{} {}",
    "UTF-16": '{"spacecraft": "XTE"}'.encode("utf-16"),
    "not UTF-8": b'{"spacecraft": "\xff\xfe"}',
    "a lone surrogate": b'{"spacecraft": "\\ud800"}',
    "deep nesting": b"[" * 500_000,
    "deep objects": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "a NUL": b"\0",
}


@pytest.mark.parametrize("name", NO_JSON)
def test_a_body_that_is_no_json_is_a_bad_request(post, name):
    answer = post(NO_JSON[name])
    assert (answer.status_code, answer.json()["type"]) == (400, "/problems/not-json")
    assert answer.json()["errors"][0]["field"] == "body"


@pytest.mark.parametrize("body", [b"[]", b"null", b"7", b'"XTE"', b"{}"])
def test_json_that_is_no_batch_is_refused(post, body):
    assert post(body).status_code == 422


def test_the_last_of_two_equal_keys_counts_whatever_it_is(post, batch):
    doubled = json.dumps(batch)[:-1] + ', "aberration": "maybe"}'
    assert post(doubled.encode()).status_code == 422


@pytest.mark.parametrize(
    "sent",
    [None, "text/plain", "application/x-www-form-urlencoded", "application/json; charset=utf-16"],
)
def test_another_content_type_is_not_read(client, batch, sent):
    headers = {} if sent is None else {"Content-Type": sent}
    answer = client.post(URL, content=json.dumps(batch), headers=headers)
    assert (answer.status_code, answer.headers["content-type"]) == (415, PROBLEM)
    assert "application/json" in answer.text or "UTF-8" in answer.text


@pytest.mark.parametrize("sent", ["application/json; charset=UTF-8", "application/vnd.b+json"])
def test_other_names_for_json_are_read(client, batch, sent):
    answer = client.post(URL, content=json.dumps(batch), headers={"Content-Type": sent})
    assert answer.status_code == 201


def test_a_compressed_body_is_not_read(post, batch):
    answer = post(batch, Content_Encoding="gzip")
    assert answer.status_code == 415
    assert answer.headers["Accept-Encoding"] == "identity"


@pytest.mark.parametrize("key", ["", "x" * 256, "k\u00e9", "tab\there"])
def test_a_key_that_cannot_be_kept_is_refused(client, batch, key):
    headers = [(b"Content-Type", b"application/json"), (b"Idempotency-Key", key.encode())]
    answer = client.post(URL, content=json.dumps(batch), headers=headers)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "Idempotency-Key"


# query: the field that is named
BAD_QUERIES = {
    f"{URL}?colour=red": "colour",
    f"{URL}?limit=0": "limit",
    f"{URL}?limit=501": "limit",
    f"{URL}?limit=ten": "limit",
    f"{URL}?limit={'9' * 5000}": "limit",
    f"{URL}?cursor=nonsense": "cursor",
    f"{URL}?cursor=": "cursor",
    f"{URL}?cursor=MS4AAAA": "cursor",
    f"{URL}?start=yesterday": "start",
    f"{URL}?end=1996-13-01T00:00:00Z": "end",
    f"{URL}?start=1997-001T00:00:00Z&end=1996-001T00:00:00Z": "query",
    f"{URL}?outcome=lost": "outcome",
    f"{URL}?status=fine": "status",
    f"{URL}?run=a%00b": "run",
    f"{URL}?spacecraft=%00": "spacecraft",
    f"{URL}?spacecraft=": "spacecraft",
    f"{URL}/{NO_ID}?full=1": "full",
    "/api/v1/spacecraft/XTE/rates?bucket=week": "bucket",
    "/api/v1/spacecraft/XTE/rates?start=1e9": "start",
    "/api/v1/spacecraft/XTE/attitudes?limit=-1": "limit",
    "/api/v1/spacecraft?name=XTE": "name",
    "/api/v1/runs?a=1": "a",
    "/api/v1/zones?spacecraft=XTE": "spacecraft",
    "/livez?a=1": "a",
}


@pytest.mark.parametrize("url", BAD_QUERIES)
def test_a_wrong_query_is_named(client, url):
    answer = client.get(url)
    assert (answer.status_code, answer.headers["content-type"]) == (422, PROBLEM), answer.text
    assert BAD_QUERIES[url] in {each["field"] for each in answer.json()["errors"]}


@pytest.mark.parametrize(
    "url",
    [
        "/nothing",
        "/api/v1",
        "/api/v1/batches/",
        "/api/v1/batches/1",
        f"/api/v1/batches/{NO_ID}",
        "/api/v1/batches/%00",
        "/api/v1/batches/%ED%A0%80",
        "/api/v1/batches/..%2F..%2Fetc%2Fpasswd",
        "/api/v1/spacecraft/%00%ff",
        "/api/v1/spacecraft/NOPE/rates",
        "/api/v1/spacecraft/NOPE/attitudes",
        f"/api/v1/replays/{NO_ID}",
        "/static/../app.py",
        "/static/%2e%2e/page.py",
        "/static/nothing.css",
        "/redoc",
    ],
)
def test_what_is_not_there_is_a_problem_too(client, url):
    answer = client.get(url)
    assert (answer.status_code, answer.headers["content-type"]) == (404, PROBLEM)
    assert answer.json()["status"] == 404


@pytest.mark.parametrize(
    ("method", "url", "allowed"),
    [
        ("PUT", URL, "GET, HEAD, POST"),
        ("DELETE", f"{URL}/{NO_ID}", "GET, HEAD"),
        ("GET", f"{URL}/{NO_ID}/what-if", "POST"),
        ("PATCH", "/api/v1/zones", "DELETE, GET, HEAD, POST"),
        ("POST", "/", "GET, HEAD"),
        ("OPTIONS", "/livez", "GET, HEAD"),
        ("POST", "/static/page.css", "GET, HEAD"),
    ],
)
def test_a_wrong_method_names_the_right_ones(client, method, url, allowed):
    answer = client.request(method, url)
    assert (answer.status_code, answer.headers["content-type"]) == (405, PROBLEM)
    assert answer.headers["Allow"] == allowed


@pytest.mark.parametrize("url", ["/", URL, "/livez", "/nothing", "/static/page.css"])
def test_head_answers_as_get_without_the_body(client, url):
    head, get = client.head(url), client.get(url)
    assert (head.status_code, head.content) == (get.status_code, b"")
    assert head.headers["content-type"] == get.headers["content-type"]


BAD_WHAT_IFS = {
    "an unknown field": ({"option": {}}, "option"),
    "an unknown tolerance": (
        {"options": {"tolerances": {"SEPTOL": 1}}},
        "options.tolerances.SEPTOL",
    ),
    "an unknown identifier": ({"options": {"identifier": "guess"}}, "options.identifier"),
    "a word for a switch": ({"record": "perhaps"}, "record"),
}


@pytest.mark.parametrize("name", BAD_WHAT_IFS)
def test_a_wrong_what_if_is_named(post, batch, client, name):
    asked, field = BAD_WHAT_IFS[name]
    answer = client.post(f"{URL}/{post(batch).json()['id']}/what-if", json=asked)
    assert answer.status_code == 422
    assert field in {each["field"] for each in answer.json()["errors"]}


def test_a_what_if_of_nothing_is_not_found(client):
    assert client.post(f"{URL}/{NO_ID}/what-if", json={}).status_code == 404


@pytest.mark.parametrize(
    ("asked", "status", "field"),
    [
        ({"spacecraft": "NOPE", "time": "1999-001T00:00:00Z"}, 422, "a_priori"),
        ({"spacecraft": "XTE", "time": "noon", "a_priori": [{"sun_pointed": True}]}, 422, "time"),
        ({"spacecraft": "XTE", "time": "1999-001T00:00:00Z", "a_priori": []}, 422, "a_priori"),
        (
            {
                "spacecraft": "XTE",
                "time": "1999-001T00:00:00Z",
                "a_priori": [{"quaternion": [0, 0, 0, 9]}],
            },
            422,
            "a_priori.0.quaternion",
        ),
    ],
)
def test_wrong_zones_to_warm_are_named(client, asked, status, field):
    answer = client.post("/api/v1/zones", json=asked)
    assert answer.status_code == status
    assert any(each["field"].startswith(field) for each in answer.json()["errors"])


def test_zones_and_batches_of_an_unknown_spacecraft_are_a_fault_of_its_field(client):
    asked = {
        "spacecraft": "NOPE",
        "time": "1999-001T00:00:00Z",
        "a_priori": [{"quaternion": [0, 0, 0, 1]}],
    }
    for answer in (
        client.post("/api/v1/zones", json=asked),
        client.delete("/api/v1/zones?spacecraft=NOPE"),
        client.get("/api/v1/batches?spacecraft=NOPE"),
    ):
        assert answer.status_code == 422
        assert answer.json()["errors"][0]["field"] == "spacecraft"
    assert client.get("/api/v1/spacecraft/NOPE").status_code == 404


def test_a_problem_can_carry_whatever_the_client_sent(post, batch):
    """Text that UTF-8 cannot hold, markup, and the ends of lines come back as plain JSON."""
    hostile = "\u2028</script>\x7f\U0001f680"
    answer = post(batch | {"spacecraft": hostile})
    assert answer.status_code in (404, 422)
    assert json.loads(answer.content)


def test_an_odd_request_line_is_refused_by_the_server(address):
    with httpx.Client(base_url=address) as client:
        answer = client.get("/", headers={"Host": "a b"})
    assert answer.status_code < 500


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_a_request_under_a_name_that_is_not_this_machines_is_refused(address, host):
    """A page whose own name leads here would else be let in as this host."""
    with httpx.Client(base_url=address) as client:
        answer = client.get("/api/v1/runs", headers={"Host": host})
    assert answer.status_code == 421
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "host", ["localhost:8000", "LOCALHOST", "127.0.0.1", "127.9.9.9:1", "[::1]:8"]
)
def test_every_name_of_this_machine_is_answered(address, host):
    with httpx.Client(base_url=address) as client:
        assert client.get("/livez", headers={"Host": host}).status_code == 200


def test_a_what_if_takes_no_key_that_it_would_not_heed(client, post, batch):
    id = post(batch).json()["id"]
    answer = client.post(
        f"/api/v1/batches/{id}/what-if", json={"record": True}, headers={"Idempotency-Key": "k"}
    )
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "Idempotency-Key"


@pytest.mark.parametrize("name", ["record", "adopt"])
def test_what_is_kept_is_asked_for_with_true_and_nothing_like_it(client, post, batch, name):
    id = post(batch).json()["id"]
    answer = client.post(f"/api/v1/batches/{id}/what-if", json={name: "yes"})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == name


def test_a_missing_run_of_a_replay_is_told_once(client):
    headers = {"Content-Type": "application/x-ndjson"}
    answer = client.post("/api/v1/replays", content=b"{}", headers=headers)
    assert [each["field"] for each in answer.json()["errors"]] == ["run"]
