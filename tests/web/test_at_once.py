"""The same batch under the same key from fifty connections at the same moment, again and again."""

import hashlib
import json
import random
import re
import socket

import httpx
import pytest
from sqlalchemy import func, select

from service.app.factory import open_app
from service.storage.sql.tables import batches, idempotency_keys, results
from tests.scale import size
from tests.storage import samples
from tests.storage.whole import assert_whole
from tests.web.serving import in_process_settings, served

ROUNDS, CONNECTIONS = 1_000, 50
LENGTH = re.compile(rb"\r\ncontent-length: (\d+)\r\n", re.IGNORECASE)


class Connection:
    """Sends what was made before and reads what comes back, with nothing between the two."""

    def __init__(self, port):
        self._port, self._socket = port, None
        self.opened = 0

    def send(self, request):
        try:
            if self._socket is None:
                self._socket = socket.create_connection(("127.0.0.1", self._port), timeout=300)
                self.opened += 1
            self._socket.sendall(request)
        except ConnectionError:
            self.close()

    def receive(self):
        """The status and the body; None where the connection was idle too long and is closed."""
        try:
            said = b""
            while b"\r\n\r\n" not in said:
                said += self._more()
            head, _, body = said.partition(b"\r\n\r\n")
            length = int(LENGTH.search(head + b"\r\n")[1])
            while len(body) < length:
                body += self._more()
            assert len(body) == length
            return int(head.split()[1]), body
        except ConnectionError:
            self.close()
            return None

    def _more(self):
        piece = b"" if self._socket is None else self._socket.recv(1 << 16)
        if not piece:
            raise ConnectionResetError
        return piece

    def close(self):
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def request_of(body, key):
    head = (
        "POST /api/v1/batches HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
        f"Idempotency-Key: {key}\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    return (head + body).encode()


@pytest.mark.slow
@pytest.mark.torture
def test_the_same_key_fifty_times_at_once_is_one_record_and_one_answer(
    database, sky, missions, seed, figures
):
    rounds, draw = size(ROUNDS, len(samples.KINDS)), random.Random(seed)
    acknowledged, repeated = {}, 0
    with served(database) as (_, url):
        connections = [Connection(httpx.URL(url).port) for _ in range(CONNECTIONS)]
        for number in range(rounds):
            kind = samples.KINDS[number % len(samples.KINDS)]
            name = f"round-{number}"
            body = samples.batch(sky, missions, name, kind=kind, after_s=60.0 * number)
            request, waiting, said = request_of(body, name), connections, []
            while waiting:
                draw.shuffle(waiting)
                for each in waiting:
                    each.send(request)
                answers = [(each, each.receive()) for each in waiting]
                said += [answer for _, answer in answers if answer is not None]
                # As a client does whose connection was closed: it sends the same again.
                waiting = [each for each, answer in answers if answer is None]
                repeated += len(waiting)
            assert sorted(status for status, _ in said) == [200] * (CONNECTIONS - 1) + [201]
            (answer,) = {answer for _, answer in said}
            acknowledged[json.loads(answer)["id"]] = hashlib.sha256(answer).hexdigest()
        for each in connections:
            each.close()
    assert len(acknowledged) == rounds
    app = open_app(in_process_settings(database))
    try:
        assert_whole(app, acknowledged)
        with app.store.reading() as connection:
            for table in (batches, results, idempotency_keys):
                assert connection.scalar(select(func.count()).select_from(table)) == rounds
    finally:
        app.close()
    figures(
        rounds=rounds,
        at_once=CONNECTIONS,
        answers=rounds * CONNECTIONS,
        sent_again=repeated,
        records=len(acknowledged),
    )
