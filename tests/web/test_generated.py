"""Requests made up from openapi.yaml, valid and not, alone and one after another.

Every answer must be one that the description knows, and never a fault of ours.
"""

import json
import sys
import traceback
from collections import Counter
from contextlib import suppress

import hypothesis
import pytest
import requests
import schemathesis
from httpx import URL, Headers
from hypothesis import strategies as st
from schemathesis import GenerationMode

from tests.scale import size
from tests.web.conformance import FILE, check_answer
from tests.web.serving import served

REQUESTS, SEQUENCES = 100_000, 10_000
STEPS = 6
ATTEMPTS = 50
"""How many seeds are tried until all sequences have run."""
PATIENCE_S = 300.0
"""There may be much other work on the machine; what takes longer than this hangs."""
PICTURES = ("application/fits", "image/fits", "image/tiff", "image/png", "application/x-npy")


def as_text(value):
    """A body as the text that it is; JSON where something else was made up."""
    return (value if isinstance(value, str) else json.dumps(value)).encode("utf-8", "replace")


@schemathesis.serializer("application/x-ndjson")
def as_lines(context, value):
    """A body of lines."""
    return as_text(value)


@schemathesis.serializer(*PICTURES)
def as_file(context, value):
    """The bytes that were made up in a picture's stead."""
    made_up = value if isinstance(value, bytes) else getattr(value, "data", None)
    return as_text(value) if made_up is None else made_up


described = schemathesis.openapi.from_path(FILE).exclude(path_regex="/events$")

settled = hypothesis.settings(
    deadline=None,
    # The seed is given to each test below.
    derandomize=False,
    database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
    # What failed is told as it was found: to make it smaller takes minutes over HTTP.
    phases=(hypothesis.Phase.generate,),
)


@pytest.fixture(scope="module")
def ready(chosen_database):
    """The address of the service as it is served, in its two processes, ready."""
    with served(chosen_database()) as (_, url):
        yield url


class Answers:
    """Every answer by its status, and the first fault of each operation.

    A fault is kept and told at the end: raised, it would be sent once more by hypothesis,
    and may not show again on a server whose records have changed.
    """

    def __init__(self):
        self.counts, self.faults = Counter(), {}
        self._session = requests.Session()

    def take(self, case, response):
        """Note an answer: it must be no fault of ours, and one that is described."""
        status, sent = response.status_code, response.request
        self.counts[status] += 1
        headers = Headers({name: ", ".join(all) for name, all in response.headers.items()})
        try:
            assert status < 500 or status == 503, status
            check_answer(sent.method, URL(sent.url), status, headers, lambda: response.content)
        except Exception as error:
            # Whatever is wrong is told at the end, each kind of it once: the rest is still asked.
            fault = f"{error!r:.2000}\n{case.as_curl_command():.2000}"
            self.faults.setdefault((case.operation.label, type(error), status), fault)

    def ask(self, case, **wanted):
        """The answer; where there is none for long, what every thread was doing is noted."""
        try:
            return case.call(session=self._session, timeout=PATIENCE_S, **wanted)
        except requests.Timeout:
            threads = "\n".join(
                "".join(traceback.format_stack(frame)) for frame in sys._current_frames().values()
            )
            self.faults[case.operation.label, requests.Timeout, None] = (
                f"{case.as_curl_command():.2000}\n{threads}"
            )
            raise

    def close(self):
        self._session.close()

    def told(self):
        """What came of them, for `figures`."""
        return {"requests": self.counts.total(), "by_status": dict(sorted(self.counts.items()))}

    def require_no_fault(self):
        told = [f"{key[0]}: {fault}" for key, fault in self.faults.items()]
        assert not told, "\n\n".join(told)


@pytest.fixture
def answers():
    taken = Answers()
    yield taken
    taken.close()


def inputs(operation):
    """How much of an operation can be made up: its parameters, and a body."""
    return len(list(operation.iter_parameters())) + len(operation.body)


@pytest.mark.torture
def test_any_request_that_the_description_suggests(ready, answers, seed, figures):
    """As many of each operation; where there are not so many different ones, more of the next."""
    operations = sorted((each.ok() for each in described.get_all_operations()), key=inputs)

    def tried(operation, count):
        """How many different requests were made."""
        before = answers.counts.total()

        @hypothesis.seed(seed)
        @hypothesis.settings(settled, max_examples=count)
        @hypothesis.given(
            case=st.one_of(
                operation.as_strategy(generation_mode=mode)
                for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)
            )
        )
        def send(case):
            answers.take(case, answers.ask(case, base_url=ready))

        send()
        return answers.counts.total() - before

    left = size(REQUESTS, 2 * len(operations))
    try:
        for number, operation in enumerate(operations):
            left -= tried(operation, max(1, -(-left // (len(operations) - number))))
    finally:
        figures(operations=len(operations), **answers.told())
        answers.require_no_fault()
    assert left <= 0, f"{left} requests were not made"


@pytest.mark.torture
def test_any_sequence_of_requests(ready, answers, seed, figures):
    sequences, wanted = Counter(), size(SEQUENCES, 5)

    class Sequences(described.as_state_machine()):
        def teardown(self):
            sequences["run"] += 1

        def call(self, case, **_):
            return answers.ask(case, base_url=ready)

        def validate_response(self, response, case, **_):
            answers.take(case, response)

    def run(seed, count):
        settings = hypothesis.settings(settled, max_examples=count, stateful_step_count=STEPS)
        # The server remembers: what begins like an earlier sequence may be answered
        # otherwise, and then goes on otherwise.
        with suppress(hypothesis.errors.Flaky):
            hypothesis.seed(seed)(Sequences).run(settings=settings)

    try:
        for another in range(ATTEMPTS):
            if (left := wanted - sequences["run"]) > 0:
                run(seed + another, left)
    finally:
        figures(sequences=sequences["run"], **answers.told())
        answers.require_no_fault()
    assert sequences["run"] >= wanted
