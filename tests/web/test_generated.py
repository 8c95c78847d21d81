"""Requests made up from openapi.yaml, valid and not, alone and one after another.

Every answer must be one that the description knows, and never a fault of ours.
"""

import json
import time

import hypothesis
import pytest
import schemathesis

from tests.scale import size
from tests.web.conformance import FILE

REQUESTS, SEQUENCES = 100_000, 10_000
STEPS = 6
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


schema = schemathesis.openapi.from_path(FILE)
described = schema.exclude(path_regex="/events$")
OPERATIONS = len(list(described.get_all_operations()))

settled = hypothesis.settings(
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
    # What failed is told as it was found: to make it smaller takes minutes over HTTP.
    phases=(hypothesis.Phase.generate,),
)


@pytest.fixture(scope="module")
def ready(client):
    """The server's address, its kernels compiled."""
    for _ in range(3000):
        if client.get("/readyz").status_code == 200:
            return str(client.base_url)
        time.sleep(0.1)
    raise AssertionError("the service does not become ready")


@pytest.mark.torture
@described.parametrize()
@hypothesis.settings(settled, max_examples=size(REQUESTS) // OPERATIONS)
def test_any_request_that_the_description_suggests(case, ready):
    response = case.call(base_url=ready, timeout=60)
    assert response.status_code < 500 or response.status_code == 503


@pytest.mark.torture
def test_any_sequence_of_requests(ready):
    class Sequences(described.as_state_machine()):
        def get_call_kwargs(self, case):
            return {"base_url": ready, "timeout": 60}

        def validate_response(self, response, case, **_):
            assert response.status_code < 500 or response.status_code == 503

    Sequences.run(
        settings=hypothesis.settings(
            settled, max_examples=size(SEQUENCES), stateful_step_count=STEPS
        )
    )
