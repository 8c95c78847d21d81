"""What a line of a log looks like, and how often an error is written."""

import io
import json
import logging

import pytest

from service import logs
from tests.waiting import wait_until


@pytest.fixture
def written():
    """A logger whose lines can be read: `written(format)` gives both."""
    logger = logging.getLogger("service.of_a_test")
    logger.propagate = False
    handlers = []

    def begin(lines=logs.TextLines, period_s=60.0):
        stream = io.StringIO()
        handlers.append(logs.CountingHandler(stream, period_s))
        handlers[-1].setFormatter(lines("front"))
        logger.addHandler(handlers[-1])
        return logger, stream

    yield begin
    for each in handlers:
        logger.removeHandler(each)
        each.close()


def fail(number):
    raise ValueError(f"number {number} cannot be")


def test_an_error_that_comes_again_is_counted_and_the_count_is_written_each_period(written):
    logger, stream = written(period_s=0.3)
    (handler,) = (each for each in logger.handlers if isinstance(each, logs.CountingHandler))
    # Nothing is written meanwhile, however long that takes.
    with handler.lock:
        for number in range(50):
            logger.warning("not ready: %s", ValueError(f"{number} of 50"))
        assert len(stream.getvalue().splitlines()) == 1
    wait_until(lambda: "repeated" in stream.getvalue(), why="the count is not written")
    first, second = stream.getvalue().splitlines()
    assert "not ready: 0 of 50" in first
    assert "repeated 49 times within 0.3 s: not ready: 49 of 50 repeated=49" in second


def test_what_was_counted_is_written_at_the_end(written):
    logger, stream = written()
    for _ in range(3):
        logger.error("a disk is full")
    for each in logger.handlers:
        each.close()
    assert len(stream.getvalue().splitlines()) == 2
    assert "repeated 2 times" in stream.getvalue()


def test_another_error_is_written_even_where_its_message_is_the_same(written):
    logger, stream = written()
    for error in (ValueError("locked"), ValueError("full"), OSError("full")):
        logger.warning("not ready: %s", error)
    logger.error("not ready: %s", ValueError("locked"))
    for error in (KeyError("a"), TypeError("b")):
        logger.error("GET failed", exc_info=error)
    assert "repeated" not in stream.getvalue()
    assert len(stream.getvalue().splitlines()) == 6 + 2


def test_what_is_no_warning_is_always_written(written):
    logger, stream = written()
    logger.setLevel(logging.INFO)
    for _ in range(5):
        logger.info("a request")
    assert len(stream.getvalue().splitlines()) == 5


@pytest.mark.parametrize("lines", [logs.TextLines, logs.JsonLines])
def test_neither_tokens_nor_statements_parameters_nor_long_texts_are_written(written, lines):
    logger, stream = written(lines)
    secret = "acq_" + "Ab-_9" * 8
    try:
        fail(f"{secret}\n[parameters: ('body of a client',)]\n{'x' * 5000}")
    except ValueError:
        logger.exception("%s failed", f"GET /{secret}")
    text = stream.getvalue()
    assert "Ab-_9" not in text
    assert "body of a client" not in text
    assert "x" * 400 not in text
    assert "ValueError" in text


def test_a_text_of_a_client_begins_no_line_and_moves_no_cursor(written):
    logger, stream = written()
    logger.warning("GET /%s", "a\n2026-01-01T00:00:00.000Z error forged\r\x1b[2J\u2028b")
    assert len(stream.getvalue().splitlines()) == 1
    assert "\x1b" not in stream.getvalue()


def test_json_is_an_object_a_line_with_the_request_it_belongs_to(written):
    logger, stream = written(logs.JsonLines)
    held = logs.request.set(logs.RequestContext("r-1", "J. Operator", "pass-7"))
    try:
        logger.warning("of a request")
    finally:
        logs.request.reset(held)
    logger.warning("of none", extra={"run": "other"})
    first, second = map(json.loads, stream.getvalue().splitlines())
    assert (first["request_id"], first["caller"], first["run"]) == ("r-1", "J. Operator", "pass-7")
    assert first["time"].endswith("Z")
    assert (first["level"], first["process"]) == ("warning", "front")
    assert (second["run"], "request_id" in second) == ("other", False)
