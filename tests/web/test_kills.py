"""A server that is killed again and again under load keeps every batch it acknowledged, once."""

import json
import signal
import socket
import subprocess
import sys
import time

import pytest
from sqlalchemy import make_url, select

from service.app.factory import open_app
from service.storage.sql.tables import batches
from tests.scale import size
from tests.storage import samples
from tests.storage.whole import assert_whole
from tests.waiting import wait_until
from tests.web.load import Load
from tests.web.serving import in_process_settings, is_ready

KILLS = {"sqlite": 500, "postgresql": 100}
ACKNOWLEDGED_A_ROUND = 2_000
"""At full size: a million in all on SQLite."""


@pytest.mark.torture
def test_a_server_killed_under_load_loses_tears_and_doubles_nothing(
    database, sky, missions, rng, figures
):
    kills = size(KILLS[make_url(database).get_backend_name()])
    a_round = size(ACKNOWLEDGED_A_ROUND, 100)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    template = samples.batch(sky, missions, "NAME")
    assert json.loads(template)["batch"] == "NAME"

    def serve():
        server = subprocess.Popen(
            [*command, "--database", database], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        wait_until(lambda: is_ready(server, url, "livez"), 600.0, every_s=0.02)
        return server

    server = serve()
    load = Load(port, template)
    try:
        for _ in range(kills):
            wanted = len(load.acknowledged) + a_round
            wait_until(lambda wanted=wanted: len(load.acknowledged) >= wanted, 300.0)
            time.sleep(float(rng.uniform(0, 0.05)))
            server.send_signal(signal.SIGKILL)
            server.wait()
            server = serve()
        load.stop()
    finally:
        load.give_up()
        server.terminate()
        server.wait()

    figures(kills=kills, acknowledged=len(load.acknowledged), answers=dict(load.met))
    assert len(load.acknowledged) >= kills * a_round
    app = open_app(in_process_settings(database))
    try:
        assert_whole(app, dict(load.acknowledged.values()))
        with app.store.reading() as connection:
            held = dict(connection.execute(select(batches.c.batch, batches.c.id)).all())
        # Nothing is left waiting at the end: what is there is what was acknowledged, one for one.
        assert held == {name: id for name, (id, _) in load.acknowledged.items()}
    finally:
        app.close()
