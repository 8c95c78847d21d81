"""While nothing can be written the service says so, and takes it back once it can write again."""

import itertools
import resource
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.scale import size
from tests.storage import samples
from tests.waiting import wait_until
from tests.web.serving import served
from tests.web.test_hanging_database import descendants, locked, ready_again


def metric(url, name):
    told = httpx.get(f"{url}/metrics", timeout=30).text
    return next(
        sample.value
        for family in text_string_to_metric_families(told)
        for sample in family.samples
        if sample.name == name
    )


def let_files_grow(pid, most_bytes):
    """Bound the size of every file that the service's processes write to, as a full disk would."""
    for each in descendants(pid):
        _, hard = resource.prlimit(each, resource.RLIMIT_FSIZE)
        resource.prlimit(each, resource.RLIMIT_FSIZE, (most_bytes, hard))


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_readiness_knows_how_the_last_write_ended(database, sky, missions):
    with served(database) as (process, url):

        def post(name):
            body = samples.batch(sky, missions, name)
            headers = {"Content-Type": "application/json", "Idempotency-Key": name}
            return httpx.post(f"{url}/api/v1/batches", content=body, headers=headers, timeout=30)

        assert post("first").status_code == 201
        assert metric(url, "starid_last_write_succeeded") == 1.0
        log = Path(database.removeprefix("sqlite:///") + "-wal")
        let_files_grow(process.pid, log.stat().st_size)
        refused = [post(f"refused-{k}") for k in range(5)]
        assert {answer.status_code for answer in refused} == {503}
        assert all("Retry-After" in answer.headers for answer in refused)
        for _ in range(3):
            answer = httpx.get(f"{url}/readyz", timeout=30)
            assert (answer.status_code, "Retry-After" in answer.headers) == (503, True)
        assert httpx.get(f"{url}/livez").status_code == 200
        assert httpx.get(f"{url}/api/v1/batches").status_code == 200
        assert metric(url, "starid_last_write_succeeded") == 0.0
        assert metric(url, "starid_writes_failed_total") >= 5

        # Without a post: whoever asks whether it is ready has a write tried.
        let_files_grow(process.pid, resource.RLIM_INFINITY)
        ready_again(url)
        assert metric(url, "starid_last_write_succeeded") == 1.0
        for k in range(5):
            assert post(f"refused-{k}").status_code == 201
        assert post("first").status_code == 200


@pytest.mark.slow
@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_disk_that_fills_and_is_freed_under_load_is_told_by_every_probe(
    database, sky, missions, figures
):
    """From the first post that fails until the disk is freed: no probe says well, none is lost."""
    wal = Path(database.removeprefix("sqlite:///") + "-wal")
    answers, probes, full, numbers = [], [], [], itertools.count()
    ended = threading.Event()
    with served(database) as (process, url), ThreadPoolExecutor(4) as threads:

        def post():
            while not ended.is_set():
                body = samples.batch(sky, missions, f"b{next(numbers)}")
                headers = {"Content-Type": "application/json"}
                begun = time.monotonic()
                answer = httpx.post(
                    f"{url}/api/v1/batches", content=body, headers=headers, timeout=60
                )
                answers.append((begun, time.monotonic(), answer.status_code, body, answer.text))

        def probe():
            while not ended.wait(1.0):
                begun = time.monotonic()
                ready = httpx.get(f"{url}/readyz", timeout=60).status_code
                well = metric(url, "starid_last_write_succeeded")
                probes.append((begun, time.monotonic(), ready, well))

        begun = [threads.submit(post) for _ in range(3)] + [threads.submit(probe)]
        for _ in range(size(20, 2)):
            wait_until(lambda: wal.exists() and answers and answers[-1][2] == 201)
            filled = time.monotonic()
            let_files_grow(process.pid, wal.stat().st_size)
            time.sleep(4.0)
            full.append((filled, time.monotonic()))
            let_files_grow(process.pid, resource.RLIM_INFINITY)
            ready_again(url)
            count = len(answers)
            wait_until(lambda count=count: len(answers) > count + 5)
        ended.set()
        for each in begun:
            each.result()
        during = 0
        for filled, freed in full:
            first = min(e for b, e, status, *_ in answers if filled < b and status == 503)
            assert first < freed
            told = [each for each in probes if first < each[0] and each[1] < freed]
            assert {(ready, well) for _, _, ready, well in told} <= {(503, 0.0)}, told
            later = {s for b, e, s, *_ in answers if first < b and e < freed}
            assert later <= {503}
            during += len(told)
        assert during >= len(full)
        assert {status for _, _, status, *_ in answers} == {201, 503}
        for *_, status, body, text in answers:
            headers = {"Content-Type": "application/json"}
            again = httpx.post(f"{url}/api/v1/batches", content=body, headers=headers, timeout=60)
            if status == 201:
                assert (again.status_code, again.text) == (200, text)
            else:
                assert again.status_code in (200, 201)
        figures(filled=len(full), posts=len(answers), probes_while_full=during)


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
@pytest.mark.slow
def test_what_waits_is_counted_with_its_age(database, sky, missions):
    with served(database) as (_, url), ThreadPoolExecutor(3) as threads:

        def post(name):
            body = samples.batch(sky, missions, name)
            headers = {"Content-Type": "application/json"}
            return httpx.post(f"{url}/api/v1/batches", content=body, headers=headers, timeout=30)

        assert post("first").status_code == 201
        with locked(database, "results"):
            waiting = [threads.submit(post, f"b{k}") for k in range(3)]
            depths, ages = [], []
            while not all(each.done() for each in waiting):
                told = httpx.get(f"{url}/metrics", timeout=30).text
                found = {
                    (sample.name, sample.labels.get("queue")): sample.value
                    for family in text_string_to_metric_families(told)
                    for sample in family.samples
                }
                depths.append(found["starid_queue_depth", "posts"])
                ages.append(found["starid_queue_oldest_seconds", "posts"])
                time.sleep(0.02)
        assert {each.result().status_code for each in waiting} == {503}
        assert max(depths) == 3
        assert max(ages) > 0.5
        assert metric(url, "starid_queue_depth") == 0.0
