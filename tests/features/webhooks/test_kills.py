"""A receiver that is killed again and again gets every event, with one id and in order."""

import json
import subprocess
import sys
import time
from collections import defaultdict

import pytest

from service.app.factory import open_app
from tests.features.webhooks.conftest import HERE, LOOPBACK, NOON, serving
from tests.scale import size
from tests.waiting import wait_until
from tests.web.serving import in_process_settings

EVENTS, KILLS = 1_000, 20
SPACECRAFT = ("XTE", "SWAS", "SOHO")
HOOK = {"name": "killed", "kinds": ["annotation"]}
ALL_ARRIVE_S = 900


class Killable:
    """The program of a receiver, always on the same port."""

    def __init__(self, folder):
        self.file = folder / "received.ndjson"
        self.port = self.secret = self._process = None

    def start(self):
        command = [sys.executable, "-m", "tests.features.webhooks.receiver", str(self.port)]
        self._process = subprocess.Popen(
            [*command, self.file, self.secret], stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout.readline() == "ready\n"

    def kill(self):
        self._process.kill()
        self._process.communicate()

    def lines(self):
        text = self.file.read_text() if self.file.exists() else ""
        # A kill may have cut the last line.
        return [json.loads(each) for each in text.split("\n")[:-1] if each.endswith("}")]


@pytest.fixture
def killable(tmp_path, free_port):
    found = Killable(tmp_path)
    found.port = free_port
    yield found
    found.kill()


@pytest.mark.torture
@pytest.mark.slow
def test_all_events_arrive_at_a_receiver_that_is_killed(database, killable, rng, figures):
    events, kills = size(EVENTS, 30), size(KILLS)
    begun_s = time.monotonic()
    with serving(database) as service:
        hook = service.hook(f"http://127.0.0.1:{killable.port}/", **HOOK)
        killable.secret = hook["secret"]
        killable.start()
        written = 0
        for round_ in range(1, kills + 1):
            while written < events * round_ // kills:
                service.note(f"n{written}", SPACECRAFT[written % len(SPACECRAFT)])
                written += 1
            # Not while the service pauses after the kill before: that would interrupt nothing.
            before = len(killable.lines())
            wait_until(lambda before=before: len(killable.lines()) > before, ALL_ARRIVE_S)
            time.sleep(float(rng.uniform(0.0, 0.1)))
            killable.kill()
            time.sleep(float(rng.uniform(0.0, 0.3)))
            killable.start()
        wait_until(lambda: len({each["id"] for each in killable.lines()}) >= events, ALL_ARRIVE_S)
        wait_until(lambda: service.read(hook)["waiting"] == 0)
        assert service.read(hook)["dead"] == 0

    received = killable.lines()
    assert all(each["verified"] for each in received)
    ids, order = defaultdict(set), defaultdict(list)
    for each in received:
        text = each["told"]["data"]["text"]
        ids[text].add(each["id"])
        if text not in order[each["told"]["spacecraft"]]:
            order[each["told"]["spacecraft"]].append(text)
    figures(
        events=events,
        kills=kills,
        requests=len(received),
        repeated=len(received) - events,
        seconds=round(time.monotonic() - begun_s),
    )
    if kills == KILLS:
        assert len(received) > events, "no kill came between an event and its answer"
    assert sorted(ids) == sorted(f"n{number}" for number in range(events))
    assert {len(each) for each in ids.values()} == {1}
    assert all(each == sorted(each, key=lambda text: int(text[1:])) for each in order.values())


def test_events_recorded_while_the_service_was_down_arrive_after_its_start(
    chosen_database, killable
):
    database = chosen_database()
    with serving(database) as service:
        hook = service.hook(f"http://127.0.0.1:{killable.port}/", **HOOK)
    killable.secret = hook["secret"]
    killable.start()
    app = open_app(in_process_settings(database, webhook_networks=LOOPBACK))
    for number in range(3):
        app.annotations.add(f"n{number}", start=NOON, who="jb", spacecraft="XTE")
    app.close()
    with serving(database) as service:
        wait_until(lambda: len(killable.lines()) == 3)
        assert service.client.get(HERE).json()["items"][0]["missed"] == 0
    assert [each["told"]["data"]["text"] for each in killable.lines()] == ["n0", "n1", "n2"]
