"""Replay of batches in this process, without a server."""

import time
from collections.abc import Iterable

import msgspec

from service.app.factory import App
from service.errors import AcquisitionError, Busy, problem_of
from service.gyro.blocks import GyroBlock
from service.replay.items import (
    AttitudeCarrier,
    Item,
    LineOutcome,
    Pace,
    Report,
    reporting_to_carrier,
)

CHUNK = 500
"""Number of batches in a transaction: enough to share its cost, few enough to show progress."""


def replay_in_process(
    app: App,
    items: Iterable[Item],
    report: Report,
    pace: Pace | None = None,
    carrier: AttitudeCarrier | None = None,
) -> None:
    """Submit every line of a replay and report its outcome, in order.

    With a `carrier` each batch waits for the answer to the one before.
    """
    pace = pace or Pace()
    chunk: list[Item] = []
    for item in items:
        wait_s = pace.wait_s(item, time.monotonic())
        if carrier is not None:
            if wait_s > 0:
                time.sleep(wait_s)
            _submit(app, [carrier.prepared(item)], reporting_to_carrier(report, carrier))
            continue
        if chunk and (wait_s > 0 or len(chunk) == CHUNK):
            _submit(app, chunk, report)
            chunk = []
            wait_s = pace.wait_s(item, time.monotonic())
        if wait_s > 0:
            time.sleep(wait_s)
        chunk.append(item)
    _submit(app, chunk, report)


def _submit(app: App, chunk: list[Item], report: Report) -> None:
    answers = iter(
        app.submissions.submit_many(
            [each.submission for each in chunk if each.submission is not None]
        )
    )
    for item in chunk:
        if item.gyro is not None:
            report(_recorded(app, item, item.gyro))
            continue
        if item.submission is None:
            report(LineOutcome(item, None, problem=item.problem))
            continue
        answer = next(answers)
        if isinstance(answer, Busy):
            raise answer
        if isinstance(answer, AcquisitionError):
            report(LineOutcome(item, None, problem=problem_of(answer)))
        else:
            report(LineOutcome(item, answer.body, answer.replayed))


def _recorded(app: App, item: Item, block: GyroBlock) -> LineOutcome:
    try:
        recorded = app.gyro.record(block)
    except Busy:
        raise
    except AcquisitionError as error:
        return LineOutcome(item, None, problem=problem_of(error))
    return LineOutcome(item, msgspec.json.encode(recorded.row), recorded.replayed)
