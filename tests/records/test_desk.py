"""Who works at the desk: whoever brings batches, and somebody else while that takes long."""

import threading
import time

import pytest

from service.errors import Busy
from service.observe.wire import submission_from_json
from service.records.desk import LONG_S, MAX_WAITING, Desk, Order
from tests.records import samples

PATIENCE_S = 20.0


@pytest.fixture
def make(sky, missions):
    """Orders by name, each answered with the name."""

    def ordered(name, settle):
        text = samples.batch(sky, missions, name)
        return Order(lambda: submission_from_json(text), None, settle)

    return ordered


def opened(acquire):
    """A desk where nothing is stored before, and what is acquired is its own answer."""
    return Desk(
        look_up=lambda orders: [None] * len(orders),
        acquire=acquire,
        draft=lambda order, acquisition: acquisition,
        write=lambda drafts: list(drafts),
        threads=2,
    )


def test_who_brings_batches_works_through_them_and_what_came_meanwhile(make):
    settled = []

    def note(outcome):
        settled.append((outcome, threading.current_thread()))

    came = [[make("third", note)], []]
    desk = opened(lambda order: order.submission.batch.batch)
    desk.take_here([make("first", note), make("second", note)], lambda: came.pop(0) if came else [])
    assert settled == [(name, threading.current_thread()) for name in ("first", "second", "third")]
    desk.close()


def test_what_comes_while_one_batch_takes_long_is_asked_for_and_answered_by_another(make):
    """Fifty come one after the other; the long one ends only when all of them are answered."""
    quick = 50
    answered, over = [], threading.Event()

    def settle(outcome):
        answered.append(outcome)
        if len(answered) == quick:
            over.set()

    def acquire(order):
        name = order.submission.batch.batch
        if name == "long":
            assert over.wait(PATIENCE_S)
        return name

    names = iter(f"quick {number}" for number in range(quick))

    def more():
        # The one that works on the long batch asks before it begins: not yet then.
        at_it = time.monotonic() - began_s > LONG_S / 2
        name = next(names, None) if at_it else None
        return [make(name, settle)] if name else []

    desk = opened(acquire)
    began_s = time.monotonic()
    desk.take_here([make("long", answered.append), make("quick", settle)], more)
    desk.close()
    assert answered[-1] == "long"


def test_a_repeat_of_what_took_long_is_looked_at_when_that_is_done_whoever_is_there(make):
    """Nobody brings anything any more when it is over."""
    answered, begun, brought = [], threading.Event(), threading.Event()

    def acquire(order):
        if not begun.is_set():
            begun.set()
            assert brought.wait(PATIENCE_S)
        return order.submission.batch.batch

    desk = opened(acquire)
    first = threading.Thread(
        target=desk.take_here, args=([make("same", answered.append)], list), daemon=True
    )
    first.start()
    assert begun.wait(PATIENCE_S)
    desk.take_here([make("same", answered.append)], list)
    brought.set()
    first.join(PATIENCE_S)
    give_up = time.monotonic() + PATIENCE_S
    while len(answered) < 2 and time.monotonic() < give_up:
        time.sleep(0.001)
    assert answered == ["same", "same"]
    desk.close()


def test_those_that_are_too_many_are_refused_at_once(make):
    outcomes = []
    desk = opened(lambda order: order.submission.batch.batch)
    order = make("one", outcomes.append)
    orders = [Order(order.read, None, outcomes.append) for _ in range(MAX_WAITING + 3)]
    desk.take_here(orders, list)
    desk.close()
    refused = [each for each in outcomes if isinstance(each, Busy)]
    assert len(refused) == 3
    assert len(outcomes) == len(orders)
