"""A service that may send to this machine, and a receiver that answers as a test says."""

import queue
import socket
import threading
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx
import pytest

from service.app.factory import open_app
from service.features.webhooks import sender
from service.times import parse_utc
from service.web.app import create_app
from tests.web.serving import Server, in_process_settings

HERE = "/api/v1/webhooks"
LOOPBACK = "127.0.0.0/8"
NOON = parse_utc("1999-03-01T12:00:00Z")
WAIT_S = 20.0


@dataclass
class Request:
    """What a receiver was sent."""

    path: str
    headers: dict
    body: bytes


@dataclass
class Receiver:
    """A receiver: `answer` takes a handler and the request, by default it says 204."""

    port: int
    address: str
    answer: Callable = lambda handler, request: handler.say(204)
    requests: list = field(default_factory=list)
    arrived: queue.Queue = field(default_factory=queue.Queue)

    @property
    def url(self):
        return f"http://{self.address}:{self.port}/hook"

    def next(self, wait_s=WAIT_S):
        return self.arrived.get(timeout=wait_s)


@contextmanager
def receiving(address="127.0.0.1", port=0, wrap=None):
    """A receiver on an address of this machine; `wrap` makes TLS of its socket."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["content-length"]))
            request = Request(self.path, dict(self.headers.items()), body)
            receiver.requests.append(request)
            receiver.arrived.put(request)
            receiver.answer(self, request)

        def do_GET(self):
            receiver.requests.append(Request(self.path, dict(self.headers.items()), b""))
            self.say(200)

        def say(self, status, body=b"", **headers):
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name.replace("_", "-"), value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    class Quiet(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, *_):
            pass  # the service may hang up at any moment

    with Quiet((address, port), Handler) as server:
        if wrap is not None:
            server.socket = wrap(server.socket)
        receiver = Receiver(server.server_address[1], address)
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield receiver
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def receiver():
    with receiving() as receiver:
        yield receiver


@pytest.fixture
def soon(monkeypatch):
    """The first retry comes at once, not after 5 s."""
    monkeypatch.setattr(sender, "FIRST_DELAY_S", 0.01)
    monkeypatch.setattr(sender, "POLL_S", 0.1)


class Service:
    """A service and a client of it."""

    def __init__(self, app, client, url):
        self.app, self.client, self.url = app, client, url

    def hook(self, url, **settings):
        """Register a receiver; what the service says of it, the secret included."""
        answer = self.client.post(HERE, json={"name": "test", "url": url} | settings)
        assert answer.status_code == 201, answer.text
        return answer.json()

    def read(self, hook):
        return self.client.get(f"{HERE}/{hook['id']}").json()

    def ask(self, hook, what, **body):
        return self.client.post(f"{HERE}/{hook['id']}/{what}", json=body)

    def note(self, text, spacecraft="XTE"):
        """Cause an event of the kind `annotation`."""
        return self.app.annotations.add(text, start=NOON, who="jb", spacecraft=spacecraft)


@contextmanager
def serving(database, allowed=LOOPBACK, **client):
    app = open_app(in_process_settings(database, webhook_networks=allowed))
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60, **client) as asking:
        yield Service(app, asking, url)


@pytest.fixture
def service(chosen_database):
    with serving(chosen_database()) as service:
        yield service


@pytest.fixture
def free_port():
    """A port that nothing listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return listening.getsockname()[1]
