"""While nothing can be written the service says so, and takes it back once it can write again."""

import resource
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.storage import samples
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


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
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
