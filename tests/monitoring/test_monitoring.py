"""The rules, dashboards and units that come with the service, by the programs that read them."""

import json
import re
import shutil
import socket
import subprocess
import time
from pathlib import Path

import httpx
import pytest

from tests.fresh_databases import sqlite_at
from tests.storage import samples
from tests.web.serving import serving_in_process

HERE = Path(__file__).parent
DOCKER = HERE.parents[1] / "docker"
DASHBOARDS = sorted((DOCKER / "grafana" / "dashboards").glob("*.json"))
JSON = {"Content-Type": "application/json"}
SETTLE_S = 60.0
"""Rates need several scrapes, and recording rules an evaluation after them."""


def tool(name):
    """A program of Debian's packages prometheus and prometheus-alertmanager."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


def panels():
    """Every query of every dashboard: board, title, expression."""
    for path in DASHBOARDS:
        for panel in json.loads(path.read_text())["panels"]:
            for target in panel["targets"]:
                yield path.stem, panel["title"], target["expr"]


def test_the_configuration_is_valid():
    subprocess.run(
        [tool("promtool"), "check", "config", DOCKER / "prometheus" / "prometheus.yaml"],
        check=True,
        capture_output=True,
    )


def test_every_alert_fires_and_clears():
    named = set(re.findall(r"- alert: (\w+)", (DOCKER / "prometheus" / "alerts.yaml").read_text()))
    tried = set(re.findall(r"alertname: (\w+)\n\s+exp_alerts", (HERE / "alerts.yaml").read_text()))
    assert tried == named
    done = subprocess.run(
        [tool("promtool"), "test", "rules", HERE / "alerts.yaml"],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_routes_of_alerts_are_valid():
    subprocess.run(
        [tool("amtool"), "check-config", DOCKER / "alertmanager" / "alertmanager.yaml"],
        check=True,
        capture_output=True,
    )


def test_units_are_valid(tmp_path):
    """With a program in the place of the one that will be installed."""
    verify = tool("systemd-analyze")
    units = []
    for unit in (DOCKER / "systemd").iterdir():
        copy = tmp_path / unit.name
        copy.write_text(unit.read_text().replace("/opt/acquire/bin/acquire", "/bin/true"))
        units.append(copy)
    done = subprocess.run([verify, "verify", *units], check=False, capture_output=True, text=True)
    ours = [line for line in done.stderr.splitlines() if str(tmp_path) in line]
    assert ours == []


@pytest.fixture(scope="module")
def prometheus(tmp_path_factory, sky, missions):
    """Prometheus with our rules, which has scraped a service that took batches: ask it a query."""
    program = tool("prometheus")
    folder = tmp_path_factory.mktemp("prometheus")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with serving_in_process(sqlite_at(folder / "acquire.db")) as service:
        url = service.url
        _configure(folder, url)
        # A name that never resolves: nothing leaves this machine.
        hook = {"name": "night shift", "url": "https://receiver.invalid/hook"}
        httpx.post(f"{url}/api/v1/webhooks", json=hook).raise_for_status()
        command = [
            program,
            f"--config.file={folder / 'prometheus.yaml'}",
            f"--storage.tsdb.path={folder / 'data'}",
            f"--web.listen-address=127.0.0.1:{port}",
            "--log.level=warn",
        ]
        with subprocess.Popen(command) as process:
            try:
                yield _asking(f"http://127.0.0.1:{port}", url, sky, missions)
            finally:
                process.terminate()


def _configure(folder, url):
    text = (DOCKER / "prometheus" / "prometheus.yaml").read_text()
    text = text.replace("127.0.0.1:8000", url.removeprefix("http://"))
    text = text.replace("_interval: 15s", "_interval: 1s").replace("scrape_timeout: 5s", "")
    (folder / "prometheus.yaml").write_text(re.sub(r"alerting:.*?\n\n", "", text, flags=re.S))
    for rules in ("recording.yaml", "alerts.yaml"):
        shutil.copy(DOCKER / "prometheus" / rules, folder / rules)


def _asking(prometheus, url, sky, missions):
    sent = 0

    def ask(expression):
        """The series of a query as a panel sends it; batches go on arriving meanwhile."""
        nonlocal sent
        expression = expression.replace("$instance", ".*").replace("$spacecraft", "XTE")
        give_up = time.monotonic() + SETTLE_S
        while time.monotonic() < give_up:
            body = samples.batch(sky, missions, f"seeded-{sent}")
            httpx.post(f"{url}/api/v1/batches", content=body, headers=JSON).raise_for_status()
            sent += 1
            try:
                answer = httpx.get(f"{prometheus}/api/v1/query", params={"query": expression})
            except httpx.TransportError:
                time.sleep(0.2)
                continue
            if answer.status_code == httpx.codes.SERVICE_UNAVAILABLE:
                time.sleep(0.2)  # it starts
                continue
            assert answer.status_code == httpx.codes.OK, answer.text
            found = answer.json()["data"]["result"]
            if any(each["value"][1] != "NaN" for each in found):
                return found
            time.sleep(0.2)
        return []

    return ask


@pytest.mark.slow
def test_every_panel_shows_something_of_a_service_that_takes_batches(prometheus):
    empty = [(board, title) for board, title, query in panels() if not prometheus(query)]
    assert empty == []


@pytest.mark.parametrize("path", DASHBOARDS, ids=lambda path: path.stem)
def test_panels_do_not_overlap_and_say_what_they_show(path):
    board = json.loads(path.read_text())
    assert board["description"]
    taken = set()
    for panel in board["panels"]:
        at = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(at["x"], at["x"] + at["w"])
            for y in range(at["y"], at["y"] + at["h"])
        }
        assert not cells & taken
        assert all(0 <= x < 24 for x, _ in cells)
        taken |= cells
        assert panel["title"]
