"""The service behind nginx, below a path: pages, redirects, cookies, streams, the reference."""

import json
import shutil
import subprocess

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.waiting import wait_until
from tests.web.browser import CHROMIUM
from tests.web.serving import Server, free_port, in_process_settings

NGINX = shutil.which("nginx", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")

pytestmark = pytest.mark.skipif(NGINX is None, reason="there is no nginx on this machine")

# That of docs/access.md, without TLS.
CONFIGURATION = """
daemon off; pid {folder}/pid; error_log {folder}/error.log; worker_processes 1;
events {{}}
http {{
  access_log off; client_max_body_size 0;
  client_body_temp_path {folder}/body; proxy_temp_path {folder}/proxy;
  fastcgi_temp_path {folder}/f; uwsgi_temp_path {folder}/u; scgi_temp_path {folder}/s;
  server {{
    listen 127.0.0.1:{port};
    location /ops/acquire/ {{
      proxy_pass {upstream}{path};
      proxy_http_version 1.1;
      proxy_set_header Host $http_host;
      proxy_set_header Connection "";
      proxy_set_header X-Forwarded-For $proxy_add_x_forwarded_for;
      proxy_set_header X-Forwarded-Proto $scheme;
    }}
  }}
}}
"""


@pytest.fixture(scope="module", params=("/", ""), ids=("path_taken_off", "path_kept"))
def proxied(request, tmp_path_factory, drawn):
    """The address of a service with batches behind nginx, which may take the path off."""
    folder = tmp_path_factory.mktemp("proxy")
    app = open_app(in_process_settings(sqlite_at(folder / "acquire.db"), root_path="/ops/acquire"))
    port = free_port()
    with Server(create_app(app)) as upstream:
        text = CONFIGURATION.format(folder=folder, port=port, upstream=upstream, path=request.param)
        (folder / "nginx.conf").write_text(text)
        process = subprocess.Popen([NGINX, "-e", folder / "error.log", "-c", folder / "nginx.conf"])
        try:
            url = f"http://127.0.0.1:{port}/ops/acquire"
            wait_until(lambda: _is_ready(url), 600.0)
            for batch in drawn("XTE", 3, seed=4):
                sent = httpx.post(f"{url}/api/v1/batches", json=batch)
                assert sent.status_code == 201
                where = sent.headers["Location"]
                assert where.startswith("/ops/acquire/api/v1/batches/")
                assert httpx.get(f"http://127.0.0.1:{port}{where}").is_success
            yield url, app
        finally:
            process.terminate()
            process.wait()


def _is_ready(url):
    try:
        return httpx.get(f"{url}/readyz").is_success
    except httpx.TransportError:
        return False


def test_redirects_links_problems_and_the_reference_have_the_path(proxied):
    url, _ = proxied
    first = httpx.get(f"{url}/api/v1/batches?limit=1")
    by_name = httpx.get(f"{url}/batches/{first.json()['items'][0]['batch']}")
    assert by_name.status_code == 303
    assert by_name.headers["Location"].startswith("/ops/acquire/batches?")
    assert first.links["next"]["url"].startswith("/ops/acquire/api/v1/batches?")
    again = httpx.get(httpx.URL(url).join(first.links["next"]["url"]))
    assert again.json()["items"][0]["id"] != first.json()["items"][0]["id"]
    newest = httpx.get(f"{url}/api/v1/spacecraft/XTE/latest")
    assert newest.headers["Content-Location"].startswith("/ops/acquire/api/v1/batches/")
    refused = httpx.get(f"{url}/api/v1/batches?limit=ten").json()
    assert refused["type"] == "/ops/acquire/problems/bad-input"
    assert httpx.get(httpx.URL(url).join(refused["type"])).is_success
    assert httpx.get(f"{url}/api/v1/openapi.json").json()["servers"][0]["url"] == "/ops/acquire"
    missing = httpx.get(f"{url}/nope", headers={"Accept": "text/html"})
    assert missing.status_code == 404
    assert 'href="/ops/acquire/static/console.css"' in missing.text


def test_events_arrive_at_once(proxied, drawn):
    url, _ = proxied
    with httpx.stream("GET", f"{url}/api/v1/events", timeout=30) as stream:
        lines = stream.iter_lines()
        assert any(line == "event: hello" for line in lines)
        batch = drawn("XTE", 1, seed=9)[0] | {"batch": f"streamed-{url[-30:-20]}"}
        httpx.post(f"{url}/api/v1/batches", json=batch).raise_for_status()
        assert any(line == "event: batches" for line in lines)


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
def test_pages_work_in_a_browser_and_sign_in_keeps_its_cookie_to_the_path(proxied, browser):
    url, _ = proxied
    pages = ("/", "/batches", "/spacecraft/XTE", "/docs", "/pictures", "/alarms")
    for page in pages:
        browser.open(url + page)
        addresses = browser.run(
            "[...document.querySelectorAll('[href], [src], form[action]')].map("
            "e => e.getAttribute('href') ?? e.getAttribute('src') ?? e.getAttribute('action'))"
        )
        own = [each for each in addresses if each.startswith("/")]
        assert own
        assert all(each.startswith("/ops/acquire/") for each in own)
    browser.open(f"{url}/spacecraft/XTE")
    live = "document.getElementById('connection')?.dataset.state === 'live'"
    browser.wait(lambda: browser.run(live))
    drawn = "document.getElementById('charts')?.dataset.drawn !== undefined"
    browser.wait(lambda: browser.run(drawn))
    token = _token(url)
    browser.open(f"{url}/alarms")
    assert browser.run("location.pathname") == "/ops/acquire/sign-in"
    browser.run(
        f"document.querySelector('[name=token]').value = {json.dumps(token)};"
        "document.querySelector('#sign-in button').click()"
    )
    browser.wait(lambda: browser.run("location.pathname") == "/ops/acquire/alarms")
    cookies = browser.call("Network.getCookies", urls=[f"{url}/"])["cookies"]
    assert [each["path"] for each in cookies] == ["/ops/acquire"]
    # The scripts of the page come after its address.
    browser.wait(lambda: browser.run(live))
    browser.run("document.getElementById('sign-out').click()")
    browser.wait(lambda: browser.run("location.pathname") == "/ops/acquire/sign-in")
    assert browser.call("Network.getCookies", urls=[f"{url}/"])["cookies"] == []
    assert browser.complaints == []


def _token(url):
    """The secret of the first token, which closes the open access."""
    asked = {"name": "operator", "scopes": ["read", "operate"]}
    made = httpx.post(f"{url}/api/v1/tokens", json=asked)
    assert made.status_code == 201, made.text
    secret = made.json()["token"]
    assert isinstance(secret, str)
    return secret
