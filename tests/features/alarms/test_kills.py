"""Alarms after kills are those of a service that ran on; every third batch is out of limits."""

import json
import threading
from contextlib import ExitStack

import httpx
import pytest
from sqlalchemy import create_engine, select

from service.features.alarms.tables import alarm_actions, alarms
from service.storage.sql.engines import database_url
from service.storage.sql.tables import batches
from tests.fresh_databases import sqlite_at
from tests.scale import size
from tests.storage import samples
from tests.web.serving import served

KILLS = 100
RUNS, BATCHES = 6, 9
KINDS = ("good", "suspect", "one_star")
LIMITS = {
    "no_attitude_share": {"critical": {"high": 0.5}, "minimum_count": 1, "duration_s": 0},
    "residual_ratio": {"warning": {"high": 2.0}, "minimum_count": 1, "duration_s": 0},
}
PLACES = ("raised", "worst", "latest")


class Restarted:
    """A service that is started again whenever it was killed, and a client that tries again."""

    def __init__(self, database):
        self._database, self._held, self.process = database, ExitStack(), None

    def ask(self, method, path, content=None):
        while True:
            if self.process is None or self.process.poll() is not None:
                self._held.close()
                self.process, self._url = self._held.enter_context(served(self._database))
            headers = {"Content-Type": "application/json"}
            try:
                answer = httpx.request(
                    method, self._url + path, content=content, headers=headers, timeout=60
                )
            except httpx.TransportError:
                self.process.wait()
                continue
            if answer.status_code != 503:
                return answer

    def close(self):
        self._held.close()


def run_passes(database, sky, missions, kill_before=(), rng=None):
    """Post each run's batches and acknowledge its alarms, in one order; then what is recorded."""
    service, posted = Restarted(database), 0
    for quantity, settings in LIMITS.items():
        asked = json.dumps({"settings": settings, "who": "jb"})
        path = f"/api/v1/spacecraft/XTE/limits/{quantity}"
        service.ask("PUT", path, asked).raise_for_status()
    for run in map("run-{}".format, range(RUNS)):
        service.ask("PUT", f"/api/v1/runs/{run}", '{"alarms": true}').raise_for_status()
        for k in range(BATCHES):
            if posted in kill_before:
                threading.Timer(float(rng.uniform(0, 0.05)), service.process.kill).start()
            kind, wanted = KINDS[k % 3], {"run": run, "after_s": 60.0 * k}
            body = samples.batch(sky, missions, f"b{k}", kind=kind, **wanted)
            assert service.ask("POST", "/api/v1/batches", body).status_code in (200, 201)
            posted += 1
            if k % 4 == 3:
                for each in service.ask("GET", f"/api/v1/alarms?run={run}").json()["items"]:
                    path = f"/api/v1/alarms/{each['id']}/acknowledge"
                    # One that was noted before a kill is not noted again.
                    answer = service.ask("POST", path, '{"who": "jb"}')
                    assert answer.status_code in (200, 409), answer.text
    service.ask("GET", "/api/v1/alarms").raise_for_status()
    service.close()
    return recorded(database)


def recorded(database):
    """All alarms and what was done about them, without ids and times of the clock."""
    engine = create_engine(database_url(database))
    with engine.connect() as connection:
        names = dict(connection.execute(select(batches.c.id, batches.c.batch)).all())
        own = {row["id"]: dict(row) for row in connection.execute(select(alarms)).mappings()}
        order = select(alarm_actions).order_by(alarm_actions.c.id)
        actions = [dict(row) for row in connection.execute(order).mappings()]
    engine.dispose()
    shown = {id: [] for id in own}
    for each in actions:
        shown[each["alarm_id"]].append(
            tuple(each[name] for name in ("action", "who", "comment", "severity", "value", "time"))
        )
    found = []
    for id, row in own.items():
        kept = {name: row[name] for name in ("run", "quantity", "severity", "current_severity")}
        kept |= {f"{p}_{part}": row[f"{p}_{part}"] for p in PLACES for part in ("value", "time")}
        kept |= {p: names.get(row[f"{p}_batch_id"]) for p in PLACES}
        kept |= {name: row[f"{name}_at"] is None for name in ("returned", "cleared")}
        found.append((kept["run"], kept["quantity"], str(kept), shown[id]))
    return sorted(found)


@pytest.mark.slow
@pytest.mark.torture
def test_alarms_after_kills_are_those_of_a_service_that_ran_on(
    tmp_path, sky, missions, rng, figures
):
    kills = min(size(KILLS, 2), RUNS * BATCHES)
    before = set(rng.choice(RUNS * BATCHES, kills, replace=False).tolist())
    expected = run_passes(sqlite_at(tmp_path / "whole.db"), sky, missions)
    killed = sqlite_at(tmp_path / "killed.db")
    assert run_passes(killed, sky, missions, before, rng) == expected
    assert len(expected) >= RUNS * len(LIMITS)
    figures(kills=kills, alarms=len(expected), actions=sum(len(each[-1]) for each in expected))
