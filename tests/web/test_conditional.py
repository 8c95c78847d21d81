"""ETag and gzip: what the client holds is not sent again, and long answers are sent compressed."""

import gzip
import zlib

import httpx
import pytest

READ = (
    "/api/v1/batches?run=full&limit=50",
    "/api/v1/batches?run=full&limit=1",
    "/api/v1/spacecraft",
    "/api/v1/spacecraft/XTE/history?run=full",
    "/api/v1/openapi.json",
    "/api/v1/session",
)
LONG = READ[0]


@pytest.fixture
def plain(address):
    """A client that asks for no compression."""
    headers = {"Accept-Encoding": "identity"}
    with httpx.Client(base_url=address, headers=headers, timeout=60) as plain:
        yield plain


def raw(client, path, **headers):
    with client.stream("GET", path, headers=headers) as answer:
        return answer, b"".join(answer.iter_raw())


@pytest.mark.parametrize("path", READ)
def test_an_answer_that_the_client_holds_is_not_sent_again(plain, full_run, path):
    first = plain.get(path)
    again = plain.get(path, headers={"If-None-Match": first.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")
    for name in ("ETag", "Cache-Control", "Link"):
        assert again.headers.get(name) == first.headers.get(name)
    assert "Content-Type" not in again.headers
    assert plain.get(path, headers={"If-None-Match": 'W/"another"'}).content == first.content


@pytest.mark.parametrize(
    "form", ["{}", "*", '"other", {}', 'W/"other" ,{} , "more"', "{strong}"], ids=repr
)
def test_the_tag_is_found_among_others_weak_or_strong(plain, full_run, form):
    tag = plain.get(LONG).headers["ETag"]
    sent = form.format(tag, strong=tag.removeprefix("W/"))
    assert plain.get(LONG, headers={"If-None-Match": sent}).status_code == 304


def test_the_tag_changes_with_the_answer_and_not_with_its_form(plain, post, batch, full_run):
    _, run = post(batch), batch.get("run", "live")
    path = f"/api/v1/batches?run={run}&spacecraft=XTE"
    before = plain.get(path).headers["ETag"]
    assert plain.get(path, headers={"Accept-Encoding": "gzip"}).headers["ETag"] == before
    assert plain.head(path).headers["ETag"] == before
    post(batch | {"batch": f"{batch['batch']}-later"})
    changed = plain.get(path, headers={"If-None-Match": before})
    assert changed.status_code == 200
    assert changed.headers["ETag"] != before


def test_a_refused_request_is_not_answered_with_304(plain, full_run):
    """Whatever tag it names: the request is worked on before tags are compared."""
    tag = plain.get("/api/v1/batches?limit=ten").headers.get("ETag")
    assert tag is None
    asked = {"If-None-Match": "*"}
    assert plain.get("/api/v1/batches?limit=ten", headers=asked).status_code == 422
    assert plain.get("/api/v1/spacecraft/NOPE", headers=asked).status_code == 404


def test_long_answers_are_compressed_for_clients_that_take_it(plain, full_run):
    answer, packed = raw(plain, LONG, **{"Accept-Encoding": "gzip"})
    assert answer.headers["Content-Encoding"] == "gzip"
    assert "Accept-Encoding" in answer.headers["Vary"]
    whole = plain.get(LONG)
    assert "Content-Encoding" not in whole.headers
    assert gzip.decompress(packed) == whole.content
    assert len(packed) < len(whole.content) / 4


def test_a_stream_of_rows_is_compressed_as_it_is_made(plain, full_run):
    path = "/api/v1/spacecraft/XTE/history?run=full&format=csv"
    answer, packed = raw(plain, path, **{"Accept-Encoding": "gzip"})
    assert answer.headers["Content-Encoding"] == "gzip"
    assert zlib.decompress(packed, 16 + zlib.MAX_WBITS) == plain.get(path).content


def test_a_table_that_is_compressed_by_itself_is_sent_as_it_is(plain, full_run):
    path = "/api/v1/spacecraft/XTE/history?run=full&format=parquet"
    answer, body = raw(plain, path, **{"Accept-Encoding": "gzip"})
    assert "Content-Encoding" not in answer.headers
    assert body.startswith(b"PAR1")


@pytest.mark.parametrize("path", ["/livez", "/api/v1/session"])
def test_short_answers_are_sent_as_they_are(plain, path):
    answer, _ = raw(plain, path, **{"Accept-Encoding": "gzip"})
    assert "Content-Encoding" not in answer.headers


def test_events_are_neither_compressed_nor_held_back(address):
    with (
        httpx.Client(base_url=address, headers={"Accept-Encoding": "gzip"}) as client,
        client.stream("GET", "/api/v1/events") as answer,
    ):
        assert "Content-Encoding" not in answer.headers
        assert "ETag" not in answer.headers
        assert next(answer.iter_lines()).startswith(("id:", "event:", "retry:", ":"))


def test_head_is_answered_as_get_without_its_body(plain, full_run):
    for headers in ({}, {"Accept-Encoding": "gzip"}):
        got, body = raw(plain, LONG, **headers)
        head = plain.head(LONG, headers=headers)
        assert (head.status_code, head.content) == (200, b"")
        for name in ("ETag", "Content-Type", "Content-Encoding", "Content-Length", "Link"):
            assert head.headers.get(name) == got.headers.get(name)
        assert int(got.headers["Content-Length"]) == len(body)
    tag = {"If-None-Match": got.headers["ETag"]}
    assert plain.head(LONG, headers=tag).status_code == 304


def test_a_submission_has_no_tag_and_is_not_compressed(plain, batch):
    answer = plain.post("/api/v1/batches", json=batch, headers={"Accept-Encoding": "gzip"})
    assert answer.status_code == 201
    assert not {"ETag", "Content-Encoding", "Cache-Control"} & set(answer.headers)
