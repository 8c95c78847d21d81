"""A service that is killed while it tracks keeps what it answered, and goes on the same."""

import json
import signal

import httpx
import pytest

from service.app.factory import open_app
from service.missions.mission import SHIPPED_FOLDER, load_missions
from service.settings import Settings
from service.storage.upkeep.verify import verify
from tests.tracking.conftest import send
from tests.tracking.passes import WALK_RAD_S1_5
from tests.tracking.test_tracking import kept
from tests.web.serving import served

TABLES = f"""
[motion]
rate_walk_rad_s1_5 = {2 * WALK_RAD_S1_5!r}
rate_sigma_rad_s = 2e-4

[tracking]
"""


def unnamed(answer):
    """Without the ids of results, and whether a zone was in the cache."""
    told = kept(answer)
    prediction = told["tracking"]["prediction"]
    named = prediction and prediction | {"result": None}
    return told | {"tracking": told["tracking"] | {"prediction": named}}


@pytest.mark.slow
def test_killed_and_started_again_it_gives_the_same_record(database, flown, tmp_path, monkeypatch):
    folder = tmp_path / "missions"
    folder.mkdir()
    text = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8") + TABLES
    (folder / "xte.toml").write_text(text, encoding="utf-8")
    monkeypatch.setenv("ACQUIRE_MISSIONS", str(folder))
    undisturbed = open_app(
        Settings(database=f"sqlite:///{tmp_path / 'undisturbed.db'}", replay_processes=0),
        load_missions(folder)["XTE"],
    )
    try:
        expected = [unnamed(send(undisturbed, each.body)) for each in flown]
    finally:
        undisturbed.close()
    answers = []
    for first, end in ((0, 4), (4, 7), (7, len(flown))):
        with served(database) as (server, url), httpx.Client(base_url=url, timeout=60) as client:
            for each in flown[:first]:
                # What was answered before the kill is there, byte for byte.
                again = client.post("/api/v1/batches", json=each.body)
                assert again.status_code == 200
                assert again.content == answers[flown.index(each)]
            for each in flown[first:end]:
                answer = client.post("/api/v1/batches", json=each.body)
                assert answer.status_code == 201
                answers.append(answer.content)
            server.send_signal(signal.SIGKILL)
            server.wait()
    assert [unnamed(json.loads(each)) for each in answers] == expected
    assert verify(database) == []
