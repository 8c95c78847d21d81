"""Who may do what, held against the table of the routes themselves."""

import json
import re
import socket
import threading
import time
from contextlib import ExitStack

import httpx
import pytest
from fastapi.routing import APIRoute
from sqlalchemy import text

from service import access
from service import access as sessions
from service.app.factory import open_app
from service.errors import Unauthenticated
from service.storage.recording.ids import Ulids
from service.times import shifted, utc_now
from service.web import event_stream as live
from service.web.app import bare_app, create_app
from service.web.requests.access import COOKIE, POLICIES, authorize
from tests.waiting import wait_until
from tests.web.console_pages import console_addresses
from tests.web.serving import Server, ended, in_process_settings
from tests.web.test_bodies import raw

PATH_PARAMETERS = {
    "name": "XTE",
    "id": "01JD0000000000000000000000",
    "run": "pass-7",
    "quantity": "ambiguous_share",
    "slug": "bad-input",
    "kind": "batches",
    "token": "nobody",
}
OPEN_BESIDE_THE_ROUTES = {"/static", "/api/v1/openapi.json"}
"""What `docs/access.md` says is open, of what no policy is asked about."""
"""A little more than what is known of a token is believed for."""


class Guarded:
    """A service of its own with tokens of every kind."""

    def __init__(self, database):
        self.settings = in_process_settings(database)
        self.app = open_app(self.settings)
        self._ids = Ulids()

    def token(self, name, *scopes, days=1, **more):
        secret, created = access.new_secret(), utc_now()
        self.app.store.writer.change(
            lambda connection: access.add_token(
                connection,
                id=self._ids.new(),
                name=name,
                secret=secret,
                scopes=scopes,
                created=created.text,
                expires=shifted(created, days * 86400).text,
                **{"spacecraft": None, "rate_per_s": None} | more,
            )
        )
        return secret

    def revoke(self, name):
        self.app.store.writer.change(
            lambda connection: access.revoke_token(connection, name, utc_now().text)
        )


@pytest.fixture(scope="module")
def guarded(chosen_database):
    service = Guarded(chosen_database())
    service.all = service.token("all", "read", "submit", "operate")
    service.expired = service.token("expired", "read", "submit", "operate", days=-1)
    service.revoked = service.token("revoked", "read", "submit", "operate")
    service.revoke("revoked")
    service.of_scope = {each: service.token(each, each) for each in access.SCOPES}
    service.swas = service.token("swas", "read", "submit", "operate", spacecraft=["SWAS"])
    web_app = create_app(service.app)
    service.routes = web_app.state.routes
    with Server(web_app) as service.url:
        yield service


@pytest.fixture(scope="module")
def anybody(guarded):
    with httpx.Client(base_url=guarded.url, timeout=60) as client:
        yield client


class Stream:
    """An event stream that was begun, and is read to its end in a thread."""

    def __init__(self, url, headers):
        self._client = httpx.Client(base_url=url, timeout=60)
        request = self._client.build_request("GET", "/api/v1/events", headers=headers)
        self._answer = self._client.send(request, stream=True)
        assert self._answer.status_code == 200, self._answer.read()
        self._socket = self._answer.extensions["network_stream"].get_extra_info("socket")
        self.ended = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        try:
            for _ in self._answer.iter_raw():
                pass
        except (httpx.HTTPError, OSError):
            pass
        self.ended.set()

    def close(self):
        if not self.ended.is_set():
            self._socket.shutdown(socket.SHUT_RDWR)
        assert self.ended.wait(10)
        self._answer.close()
        self._client.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def shown(token):
    return {"Authorization": f"Bearer {token}"}


def asked(client, method, path, **more):
    """The answer's status and headers; its body may be a stream without an end."""
    with client.stream(method, path, **more) as response:
        return response


def replay_begun(client, token, lines, query="run=bound"):
    headers = shown(token) | {"Content-Type": "application/x-ndjson"}
    content = "\n".join(json.dumps(each) for each in lines)
    return client.post(f"/api/v1/replays?{query}", content=content, headers=headers)


def requests_of(routes):
    """A request to every route: its name, method and a path that fits."""
    for route in routes:
        path = re.sub(r"\{(\w+)[^}]*\}", lambda found: PATH_PARAMETERS[found[1]], route.path)
        for method in sorted(route.methods - {"HEAD"}):
            yield route.name, method, path


def test_every_route_has_a_policy_and_every_policy_a_route(guarded):
    """A new route without one would be refused to everybody; an old policy would mislead."""
    assert {route.name for route in guarded.routes} == set(POLICIES)


def test_what_stands_beside_the_guarded_routes_is_known_to_be_open(guarded, anybody):
    """Whatever is added to the app itself never reaches `authorize`, which requires a policy."""
    beside = set()
    web_app = bare_app()
    for each in web_app.router.routes:
        if getattr(each, "original_router", None) in web_app.state.routers:
            assert authorize in [asked.dependency for asked in each.include_context.dependencies]
        else:
            beside.add(each.path)
    assert beside == OPEN_BESIDE_THE_ROUTES
    # Routes of any other kind have no dependencies, so `authorize` would not be called.
    assert all(isinstance(each, APIRoute) for each in guarded.routes)
    for path in ("/static/console.css", "/static/sign-in.js", "/api/v1/openapi.json"):
        assert anybody.get(path).status_code == 200, path


def test_without_a_good_token_nothing_but_the_open_routes_answers(guarded, anybody):
    """No token, an unknown one, an expired one, a revoked one: each route refuses each alike."""
    bad = [{}, shown("acq_unknown"), shown(guarded.expired), shown(guarded.revoked)]
    bad += [{"Authorization": "Basic YTpi"}, {"Cookie": f"{COOKIE}=acq_unknown"}]
    for name, method, path in requests_of(guarded.routes):
        for headers in bad:
            response = asked(anybody, method, path, headers=headers)
            if POLICIES[name].open:
                assert response.status_code not in (403, 500), (name, headers)
            elif response.status_code == 303:
                assert response.headers["Location"].startswith("/sign-in?next="), name
            else:
                assert response.status_code == 401, (name, headers)
                assert response.headers["WWW-Authenticate"].startswith("Bearer"), name


def test_a_token_without_the_scope_is_refused_by_every_route(guarded, anybody):
    """And one with it is let through to whatever the route says then."""
    for name, method, path in requests_of(guarded.routes):
        policy = POLICIES[name]
        if policy.open:
            continue
        for scope, token in guarded.of_scope.items():
            response = asked(anybody, method, path, headers=shown(token))
            refused = response.status_code == 403
            assert refused == (scope not in policy.scopes), (name, scope)
            assert response.status_code < 500, (name, scope)


def test_a_token_of_another_spacecraft_is_refused_by_every_route_about_one(guarded, anybody):
    for name, method, path in requests_of(guarded.routes):
        policy = POLICIES[name]
        if policy.open or policy.spacecraft_in in ("nothing", "body"):
            continue
        query = {"spacecraft": "XTE"} if policy.spacecraft_in == "query" else None
        response = asked(anybody, method, path, params=query, headers=shown(guarded.swas))
        wanted = 404 if policy.spacecraft_in == "result" else 403
        assert response.status_code == wanted, name
        if policy.spacecraft_in == "query":
            assert asked(anybody, method, path, headers=shown(guarded.swas)).status_code == 403


def test_every_page_answers_the_token_of_a_spacecraft_without_a_mission_file(guarded, anybody):
    gone = shown(guarded.token("gone", "read", "submit", "operate", spacecraft=["GONE"]))
    for path in console_addresses():
        assert anybody.get(path, headers=gone).status_code < 500, path


def test_a_bound_token_submits_reads_and_replays_its_own_spacecraft_alone(guarded, anybody, drawn):
    swas, xte = drawn("SWAS", 1)[0], drawn("XTE", 1)[0]
    own = anybody.post("/api/v1/batches", json=swas, headers=shown(guarded.swas))
    other = anybody.post("/api/v1/batches", json=xte, headers=shown(guarded.swas))
    assert (own.status_code, other.status_code) == (201, 403)
    kept = anybody.post("/api/v1/batches", json=xte, headers=shown(guarded.all))
    for answer, status in ((own, 200), (kept, 404)):
        path = answer.headers["Location"]
        assert anybody.get(path, headers=shown(guarded.swas)).status_code == status
        tried = anybody.post(path + "/what-if", json={}, headers=shown(guarded.swas))
        assert tried.status_code == status
    warm = {"spacecraft": "XTE", "time": xte["time"], "a_priori": [xte["a_priori"]]}
    warmed = anybody.post("/api/v1/zones", json=warm, headers=shown(guarded.swas))
    assert warmed.status_code == 403
    listed = anybody.get("/api/v1/spacecraft", headers=shown(guarded.swas)).json()["items"]
    assert [each["name"] for each in listed] == ["SWAS"]

    begun = replay_begun(anybody, guarded.swas, (swas, xte, swas | {"batch": "another"}))
    assert begun.status_code == 202
    state = ended(anybody, begun, headers=shown(guarded.swas))
    assert (state["lines"]["done"], state["lines"]["refused"]) == (3, 1)
    assert [each["line"] for each in state["errors"]] == [2]
    assert "SWAS, not to XTE" in state["errors"][0]["problem"]["detail"]


def test_whoever_may_start_a_replay_may_follow_it(guarded, anybody, drawn):
    """With `submit` alone too; the list of replays needs `read`."""
    submitting = guarded.of_scope["submit"]
    begun = replay_begun(anybody, submitting, drawn("XTE", 2), "run=followed")
    assert ended(anybody, begun, headers=shown(submitting))["counts"]["new"] == 2
    assert anybody.get("/api/v1/replays", headers=shown(submitting)).status_code == 403
    # A bound token has those into runs of its spacecraft alone.
    own = replay_begun(anybody, guarded.swas, drawn("SWAS", 2), "run=swas-alone")
    ended(anybody, own, headers=shown(guarded.swas))
    (found,) = (
        each
        for each in anybody.get("/api/v1/replays", headers=shown(guarded.swas)).json()["items"]
        if each["run"] in ("followed", "swas-alone")
    )
    assert found["id"] == own.json()["id"]
    operating = shown(guarded.of_scope["operate"])
    refused = anybody.get(begun.headers["Location"], headers=operating)
    assert "needs the scope read or submit" in refused.json()["detail"]


def test_a_bound_token_has_no_alarms_of_a_run_switched(guarded, anybody, drawn):
    """The run may hold batches of every spacecraft; who is bound to none may, and it is noted."""
    bound, unbound = shown(guarded.swas), shown(guarded.of_scope["submit"])
    for alarms in (True, False):
        body = {"alarms": alarms}
        assert anybody.put("/api/v1/runs/all", json=body, headers=bound).status_code == 403
    batches = drawn("SWAS", 1)
    refused = replay_begun(anybody, guarded.swas, batches, "run=all&alarms=true")
    assert (refused.status_code, "all of them" in refused.json()["detail"]) == (403, True)

    begun = replay_begun(anybody, guarded.of_scope["submit"], batches, "run=all&alarms=true")
    ended(anybody, begun, headers=unbound)
    body = {"alarms": False}
    assert anybody.put("/api/v1/runs/all", json=body, headers=unbound).status_code == 200
    listed = anybody.get("/api/v1/audit?limit=2", headers=shown(guarded.all)).json()["items"]
    assert [(each["who"], each["action"], each["about"]) for each in listed] == [
        ("submit", "watch_run", "/api/v1/runs/all"),
        ("submit", "start_replay", "/api/v1/replays?run=all&alarms=true"),
    ]
    assert json.loads(listed[0]["body"]) == body


def refused_in_the_end(client, **more):
    """What was known of a caller is forgotten: a caller who is read anew is refused."""
    wait_until(lambda: client.get("/api/v1/session", **more).status_code == 401)
    assert client.get("/api/v1/session", **more).status_code == 401


def test_a_caller_is_known_for_no_more_than_a_second():
    assert sessions.KNOWN_FOR_S <= 1.0


def test_revoking_a_token_holds_soon(guarded, anybody):
    token = guarded.token("short lived", "read")
    assert anybody.get("/api/v1/session", headers=shown(token)).status_code == 200
    guarded.revoke("short lived")
    refused_in_the_end(anybody, headers=shown(token))


def test_a_token_is_made_listed_and_revoked_at_once_by_who_operates(guarded, anybody):
    """Without a pause of the service: the token that was just used is refused at once."""
    operating = shown(guarded.of_scope["operate"])
    asked = {"name": "new one", "scopes": ["read"], "spacecraft": ["XTE"], "days": 30}
    made = anybody.post("/api/v1/tokens", json=asked, headers=operating)
    assert (made.status_code, made.json()["state"]) == (201, "good")
    secret = made.json()["token"]
    assert anybody.post("/api/v1/tokens", json=asked, headers=operating).status_code == 409
    session = anybody.get("/api/v1/session", headers=shown(secret)).json()
    assert session == {"name": "new one", "scopes": ["read"], "spacecraft": ["XTE"]}

    for path in ("/api/v1/tokens", "/tokens"):
        listed = anybody.get(path, headers=operating)
        assert "new one" in listed.text
        assert secret not in listed.text
    assert listed.text.count('data-send="DELETE /api/v1/tokens/') == listed.text.count(
        '<details id="revoke-'
    )

    ended = anybody.delete("/api/v1/tokens/new%20one", headers=operating)
    assert (ended.status_code, ended.json()["state"]) == (200, "revoked")
    assert anybody.get("/api/v1/session", headers=shown(secret)).status_code == 401
    assert anybody.delete("/api/v1/tokens/nobody", headers=operating).status_code == 404
    audited = anybody.get("/api/v1/audit?limit=4", headers=shown(guarded.all))
    assert [(each["action"], each["status"]) for each in audited.json()["items"]] == [
        ("revoke_token", 404),
        ("revoke_token", 200),
        ("add_token", 409),
        ("add_token", 201),
    ]
    assert secret not in audited.text


def test_tokens_are_no_business_of_one_that_is_bound_or_does_not_operate(guarded, anybody):
    bound = guarded.token("bound", "read", "submit", "operate", spacecraft=["XTE"])
    asked = {"name": "mine", "scopes": ["operate"]}
    for token in (bound, guarded.of_scope["read"], guarded.of_scope["submit"]):
        headers = shown(token)
        assert anybody.get("/api/v1/tokens", headers=headers).status_code == 403
        assert anybody.get("/tokens", headers=headers).status_code == 403
        assert anybody.post("/api/v1/tokens", json=asked, headers=headers).status_code == 403
        assert anybody.delete("/api/v1/tokens/all", headers=headers).status_code == 403


def test_the_command_goes_through_the_service_that_writes_to_the_file(
    guarded, acquire, monkeypatch
):
    if not guarded.settings.database.startswith("sqlite"):
        pytest.skip("a database server takes the command's own changes")
    there = ("--database", guarded.settings.database, "--url", guarded.url)
    create = ("token", "create", "by command", "--scope", "read", *there)
    code, out, err = acquire(*create)
    assert (code, out) == (2, "")
    assert "set ACQUIRE_TOKEN to a token with the scope operate" in err
    monkeypatch.setenv("ACQUIRE_TOKEN", guarded.of_scope["operate"])
    code, out, err = acquire(*create)
    # The token alone, so that a script can take it.
    assert (code, out.strip().count("\n"), out[:4]) == (0, 0, "acq_")
    assert "by command may read until" in err
    assert httpx.get(f"{guarded.url}/api/v1/session", headers=shown(out.strip())).status_code == 200
    assert acquire("token", "revoke", "by command", *there)[0] == 0
    assert httpx.get(f"{guarded.url}/api/v1/session", headers=shown(out.strip())).status_code == 401
    assert acquire("token", "revoke", "by command?", *there)[0] != 0
    code, out, _ = acquire("token", "list", "--json", *there[:2])
    assert {"by command": "revoked"}.items() <= {
        e["name"]: e["state"] for e in json.loads(out)
    }.items()


def test_a_session_is_a_cookie_that_scripts_cannot_read_and_other_sites_cannot_use(guarded, batch):
    """Signed in, a browser may what its token may; a page elsewhere changes nothing by it."""
    with httpx.Client(base_url=guarded.url, timeout=60) as browser:
        assert browser.get("/").headers["Location"] == "/sign-in?next=/"
        bad = browser.post("/api/v1/session", json={"token": "acq_no"})
        assert (bad.status_code, dict(browser.cookies)) == (401, {})
        begun = browser.post("/api/v1/session", json={"token": guarded.all})
        cookie = begun.headers["Set-Cookie"].lower()
        assert begun.json()["name"] == "all"
        assert all(word in cookie for word in ("httponly", "samesite=strict", "path=/"))
        assert guarded.all not in begun.headers["Set-Cookie"]
        assert browser.get("/").status_code == 200

        def drop(**headers):
            return browser.delete("/api/v1/zones", headers=headers).status_code

        host = guarded.url.partition("://")[2]
        own, other = f"http://{host}", "https://elsewhere.example"
        assert drop(**{"Sec-Fetch-Site": "same-origin"}) == drop(Origin=own) == 200
        assert drop(**{"Sec-Fetch-Site": "cross-site"}) == drop(Origin=other) == drop() == 403
        assert drop(**{"Sec-Fetch-Site": "same-site", "Origin": own}) == 403
        # A token in the header is sent by nobody's browser of itself.
        assert drop(**shown(guarded.all)) == 200

        kept = dict(browser.cookies)
        same = {"Sec-Fetch-Site": "same-origin"}
        assert browser.delete("/api/v1/session", headers=same).status_code == 200
        browser.cookies.update(kept)
        refused_in_the_end(browser)


@pytest.mark.parametrize("host", [b"", b"Host:\r\n"])
def test_a_session_without_a_host_changes_nothing_and_reads(guarded, host):
    """As HTTP/1.0 allows: no host can be held against the page that asks."""
    with httpx.Client(base_url=guarded.url, timeout=60) as browser:
        browser.post("/api/v1/session", json={"token": guarded.all}).raise_for_status()
        cookie = b"Cookie: acquire_session=" + browser.cookies[COOKIE].encode() + b"\r\n"

    def status(line, *headers):
        head = b"".join((line, b" HTTP/1.0\r\n", host, cookie, *headers, b"\r\n"))
        return raw(guarded.url, head).split()[1]

    assert status(b"DELETE /api/v1/zones") == b"403"
    assert status(b"DELETE /api/v1/zones", b"Origin: http://127.0.0.1\r\n") == b"403"
    assert status(b"DELETE /api/v1/zones", b"Sec-Fetch-Site: same-origin\r\n") == b"200"
    assert status(b"GET /api/v1/session") == status(b"GET /") == b"200"


def test_a_cookie_is_secure_where_a_trusted_proxy_has_tls(guarded):
    def begin(client, **headers):
        asked = {"token": guarded.all}
        begun = client.post("/api/v1/session", json=asked, headers=headers)
        begun.raise_for_status()
        return "secure" in begun.headers["Set-Cookie"].lower().split("; ")

    own = f"https://{guarded.url.partition('://')[2]}"
    # From another address than the trusted proxies, which are on this one.
    transport = httpx.HTTPTransport(local_address="127.0.0.2")
    with (
        httpx.Client(base_url=guarded.url, timeout=60) as proxy,
        httpx.Client(base_url=guarded.url, timeout=60, transport=transport) as stranger,
    ):
        told = {"X-Forwarded-Proto": "https", "X-Forwarded-For": "192.0.2.1"}
        assert begin(proxy, **told)
        cookie = {"Cookie": f"{COOKIE}={proxy.cookies.get(COOKIE)}"}
        changed = proxy.delete("/api/v1/zones", headers=told | cookie | {"Origin": own})
        assert changed.status_code == 200
        assert not begin(proxy)
        assert not begin(stranger, **told)


def test_sessions_and_tokens_end_by_clocks_that_jump_and_none_lives_on(guarded, monkeypatch):
    held, ahead_s = guarded.app.access, 0.0
    monkeypatch.setattr(held, "_now", lambda: shifted(utc_now(), ahead_s))
    token = guarded.token("of clocks", "read", days=1)

    def is_known(*, by_token=None, session=None):
        held.forget()
        try:
            held.caller(by_token, session)
        except Unauthenticated:
            return False
        return True

    session, _ = held.sign_in(token)
    for ahead_s, token_lives, session_lives in (
        (0.0, True, True),
        (11.9 * 3_600, True, True),
        (12.1 * 3_600, True, False),
        (86_401.0, False, False),
        # Back again: what had not ended by the right clock has not ended.
        (0.0, True, True),
        (-240.0, True, True),
        # What a clock a year ahead began does not last for a year.
        (-86_400.0 * 365, True, False),
    ):
        assert is_known(by_token=token) == token_lives, ahead_s
        assert is_known(session=session) == session_lives, ahead_s
    ahead_s = 0.0
    assert is_known(session=session)


@pytest.mark.parametrize("by", ["token", "session"])
def test_the_stream_of_a_revoked_token_ends(guarded, by):
    """Also where a browser listens with a session of that token; others go on."""
    name = f"listening by {by}"
    token = guarded.token(name, "read")
    headers = shown(token)
    if by == "session":
        begun = httpx.post(f"{guarded.url}/api/v1/session", json={"token": token})
        headers = {"Cookie": f"{COOKIE}={begun.cookies[COOKIE]}"}
    with Stream(guarded.url, headers) as stream, Stream(guarded.url, shown(guarded.all)) as other:
        # Longer than the time after which every listener is asked for again.
        assert not stream.ended.wait(1.2 * live.ADMITTED_EVERY_S)
        guarded.revoke(name)
        assert stream.ended.wait(60)
        assert not other.ended.is_set()
    with httpx.stream("GET", f"{guarded.url}/api/v1/events", headers=headers) as again:
        assert again.status_code == 401


def test_a_listener_is_asked_for_again_every_second():
    assert live.ADMITTED_EVERY_S + sessions.KNOWN_FOR_S <= 2.0


def test_the_stream_of_an_expired_token_ends(guarded, anybody):
    token = guarded.token("short", "read", days=2 / 86400)
    expires_s = time.monotonic() + 2
    with Stream(guarded.url, shown(token)) as stream:
        assert stream.ended.wait(60)
    assert time.monotonic() > expires_s


def test_the_first_token_ends_the_streams_of_those_who_needed_none(chosen_database):
    service = Guarded(chosen_database())
    with Server(create_app(service.app)) as url, Stream(url, {}) as stream:
        service.token("first", "read")
        assert stream.ended.wait(60)


def test_one_token_s_streams_are_bounded_and_keep_out_nobody_else(guarded):
    token = guarded.token("many streams", "read")
    with ExitStack() as streams:
        for _ in range(live.MAX_OF_ONE_TOKEN):
            last = streams.enter_context(Stream(guarded.url, shown(token)))
        refused = httpx.get(f"{guarded.url}/api/v1/events", headers=shown(token))
        assert refused.status_code == 429
        assert refused.headers["Retry-After"] == "30"
        assert "10 event streams open" in refused.json()["detail"]
        streams.enter_context(Stream(guarded.url, shown(guarded.all)))
        last.close()

        def has_room():
            answer = asked(httpx, "GET", f"{guarded.url}/api/v1/events", headers=shown(token))
            return answer.status_code == 200

        # The server sees that a client has gone a moment later.
        wait_until(has_room)


def test_a_session_ends_with_its_token(guarded):
    token = guarded.token("leaving", "read")
    with httpx.Client(base_url=guarded.url, timeout=60) as browser:
        browser.post("/api/v1/session", json={"token": token}).raise_for_status()
        assert browser.get("/api/v1/session").json()["name"] == "leaving"
        guarded.revoke("leaving")
        refused_in_the_end(browser)


def test_of_an_array_a_bound_token_records_its_own_spacecraft_alone(guarded, anybody, drawn):
    array = [each | {"run": "array"} for each in (*drawn("SWAS", 2), *drawn("XTE", 1))]
    sent = anybody.post("/api/v1/batches/many", json=array, headers=shown(guarded.swas))
    items = sent.json()["items"]
    assert [each["status"] for each in items] == [201, 201, 403]
    assert items[2]["problem"]["type"] == "/problems/not-allowed"
    listed = anybody.get("/api/v1/batches?run=array", headers=shown(guarded.all)).json()["items"]
    assert {each["spacecraft"] for each in listed} == {"SWAS"}


def test_an_array_uses_up_the_rate_of_its_token(guarded, anybody, drawn):
    token = guarded.token("arrays", "submit", rate_per_s=0.5)
    array = [each | {"run": "rated"} for each in drawn("SWAS", 8)]
    answers = [
        anybody.post("/api/v1/batches/many", json=array, headers=shown(token)) for _ in range(2)
    ]
    assert [each.status_code for each in answers] == [200, 429]
    assert int(answers[1].headers["Retry-After"]) > 5


def test_whoever_asks_too_often_is_told_when_to_come_again(guarded, anybody):
    token = guarded.token("hasty", "read", rate_per_s=0.5)
    answers = [anybody.get("/api/v1/session", headers=shown(token)) for _ in range(12)]
    refused = [each for each in answers if each.status_code == 429]
    assert 5 <= len(refused) <= 7
    assert all(1 <= int(each.headers["Retry-After"]) <= 3 for each in refused)
    # Nobody else is kept waiting by it.
    assert anybody.get("/api/v1/session", headers=shown(guarded.all)).status_code == 200


def test_what_is_changed_is_noted_with_who_changed_it(guarded, anybody, drawn):
    """Also what was refused; reading and submitting are not changes."""
    anybody.delete("/api/v1/zones?spacecraft=SWAS", headers=shown(guarded.of_scope["operate"]))
    sent = anybody.post("/api/v1/batches", json=drawn("SOHO", 1)[0], headers=shown(guarded.all))
    path = sent.headers["Location"] + "/what-if"
    anybody.post(path, json={"record": True}, headers=shown(guarded.all))
    anybody.post(path, json={}, headers=shown(guarded.all))
    anybody.post(path, json={"adopt": True}, headers=shown(guarded.of_scope["read"]))
    listed = anybody.get("/api/v1/audit", headers=shown(guarded.all)).json()["items"]
    newest = [(each["who"], each["action"], each["status"]) for each in listed[:2]]
    assert newest == [("all", "what_if", 201), ("operate", "drop_zones", 200)]
    assert json.loads(listed[0]["body"]).items() >= {"record": True}.items()
    assert listed[1]["about"] == "/api/v1/zones?spacecraft=SWAS"
    page = anybody.get("/api/v1/audit?limit=1", headers=shown(guarded.all))
    following = re.match("<([^>]+)>", page.headers["Link"])[1]
    again = anybody.get(following, headers=shown(guarded.all)).json()["items"]
    assert again[0] == listed[1]


@pytest.mark.parametrize("broken", ["audit", "limits", "event_counter"])
def test_a_change_and_its_note_are_stored_together_or_not_at_all(chosen_database, broken):
    """Whichever of the tables fails that one of them needs."""
    service = Guarded(chosen_database())
    limit = "/api/v1/spacecraft/XTE/limits/ambiguous_share"
    body = {"settings": {"warning": {"high": 0.5}}}

    def rename(old, new):
        statement = text(f"ALTER TABLE {old} RENAME TO {new}")
        service.app.context.change(lambda connection: connection.execute(statement).close())

    # Before the start: that access is open is believed for a moment.
    headers = shown(service.token("all", "read", "operate"))
    with (
        Server(create_app(service.app)) as url,
        httpx.Client(base_url=url, headers=headers, timeout=60) as client,
    ):

        def stored():
            history = client.get(limit).json()["history"]
            listed = client.get("/api/v1/audit").json()["items"]
            return len(history), [each["status"] for each in listed if each["status"] < 400]

        # A start tries a write of its own.
        wait_until(lambda: client.get("/readyz").status_code == 200)
        rename(broken, "elsewhere")
        assert client.put(limit, json=body).status_code >= 500
        rename("elsewhere", broken)
        assert stored() == (0, [])
        assert client.put(limit, json=body).status_code == 200
        assert stored() == (1, [200])


def test_each_change_is_noted_once_and_what_was_refused_too(guarded, anybody):
    headers = shown(guarded.of_scope["operate"])
    reading = shown(guarded.all)

    def newest(count):
        listed = anybody.get(f"/api/v1/audit?limit={count}", headers=reading).json()["items"]
        return [(each["action"], each["status"]) for each in listed]

    limit = "/api/v1/spacecraft/XTE/limits/ambiguous_share"
    body = {"settings": {"warning": {"high": 0.5}}}
    assert anybody.put(limit, json=body, headers=headers).status_code == 200
    assert anybody.delete(limit, headers=headers).status_code == 200
    assert anybody.put(limit, json={"settings": 1}, headers=headers).status_code == 422
    unknown = "/api/v1/alarms/01JD0000000000000000000000/acknowledge"
    assert anybody.post(unknown, json={}, headers=headers).status_code == 404
    assert newest(4) == [
        ("acknowledge_alarm", 404),
        ("set_limit", 422),
        ("reset_limit", 200),
        ("set_limit", 200),
    ]


def test_the_database_holds_nothing_that_could_be_used(guarded):
    """Tokens and sessions alike are kept as digests."""
    with guarded.app.store.reading() as connection:
        kept = "\n".join(
            str(tuple(row))
            for table in ("access_tokens", "access_sessions", "audit")
            for row in connection.exec_driver_sql(f"SELECT * FROM {table}")
        )
    assert access.secret_digest(guarded.all) in kept
    assert access.PREFIX not in kept


def test_access_is_open_on_loopback_until_the_first_token_is_made(chosen_database):
    service = Guarded(chosen_database())
    with Server(create_app(service.app)) as url, httpx.Client(base_url=url) as client:
        assert client.get("/api/v1/session").json()["name"] == "local"
        service.token("first", "read")
        refused_in_the_end(client)
        service.revoke("first")
        # Revoking the last one opens nothing, also once that is known.
        time.sleep(sessions.KNOWN_FOR_S)
        assert client.get("/api/v1/session").status_code == 401
