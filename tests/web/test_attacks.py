"""One client that sends without an end, or holds what it may: others are served as ever."""

import json
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from tests.fresh_databases import sqlite_at
from tests.scale import size
from tests.web.healthy import answers, resident_mb, tries
from tests.web.serving import served

ATTACK_S = 30
LEAST_ATTACK_S = 0.5
SETTLING = size(200, 20)
PATIENCE_S = 60
CHECKOUT = Path(__file__).parents[2]
PROBES_EVERY = 20

REFUSED = "HTTP/1.1 431 Request Header Fields Too Large"
ATTACKS = {
    # The connections at a time, and what some of them must be told.
    "header value": (4, REFUSED),
    "url": (4, REFUSED),
    "trailer": (4, REFUSED),
    "many headers": (4, REFUSED),
    "chunk extension": (4, REFUSED),
    "small chunks": (4, None),
    "blank lines": (4, REFUSED),
    "pipelined requests": (4, None),
    "idle": (2_100, None),
    "bodies": (400, "HTTP/1.1 413 Request Entity Too Large"),
    "held bodies": (400, None),
}

QUICK = ("small chunks", "idle", "held bodies")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A server in processes of its own, so that its memory is its own; ready for work."""
    with served(sqlite_at(tmp_path_factory.mktemp("attacked") / "acquire.db")) as serving:
        yield serving


@pytest.mark.torture
@pytest.mark.parametrize(
    "kind",
    # `test_heads` has each of the others refused and its connection closed.
    [pytest.param(kind, marks=[] if kind in QUICK else pytest.mark.slow) for kind in ATTACKS],
)
@pytest.mark.slow("small chunks")
@pytest.mark.slow("held bodies")
def test_an_attack_costs_a_healthy_client_nothing(server, batch, kind, figures):
    """Its posts and its probes are answered, and memory is kept; at full size as soon as ever."""
    process, url = server
    connections, told = ATTACKS[kind]
    seconds = max(LEAST_ATTACK_S, size(ATTACK_S))
    names = iter(f"{kind}-{number}" for number in range(1_000_000))
    heard = []

    def while_attacked(client):
        command = [sys.executable, "-m", "tests.web.attack", str(httpx.URL(url).port), kind]
        with subprocess.Popen(
            [*command, str(connections), told or ""],
            cwd=CHECKOUT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as attack:
            # To answer hundreds that come at once is work like any other, and soon done.
            answers(client, batch, names, SETTLING)
            taken, most_mb, until_s = [], 0.0, time.monotonic() + seconds
            while time.monotonic() < until_s:
                taken += answers(client, batch, names, PROBES_EVERY)
                # As a probe comes: over a connection of its own.
                assert httpx.get(f"{url}/livez", timeout=PATIENCE_S).status_code == 200
                most_mb = max(most_mb, resident_mb(process))
            output, _ = attack.communicate()
        heard.append(json.loads(output))
        return taken, most_mb

    def alone(client):
        taken, until_s = [], time.monotonic() + seconds / 4
        while time.monotonic() < until_s:
            taken += answers(client, batch, names, PROBES_EVERY)
            assert httpx.get(f"{url}/livez", timeout=PATIENCE_S).status_code == 200
        return taken

    with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        answers(client, batch, names, SETTLING)
        tried = tries(process, lambda: alone(client), lambda: while_attacked(client))
    figures(kind=kind, seconds=seconds, heard=heard[-1], tries=list(map(str, tried)))
    if told is not None:
        assert told in heard[-1]["told"]
