"""Replay through a running service: several posts at a time, or one upload.

A post whose answer was lost is sent again: the service recognises the batch by its identity and
records it once.
"""

import asyncio
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from acquire_client import AsyncClient, Client, RecordedAnswer, Repeat
from acquire_client import errors as answers
from acquire_client.encoding import checked_address, path_of
from acquire_client.models import Replay
from msgspec import to_builtins

from service import errors
from service.gyro.blocks import json_of_block
from service.observations.telemetry import read_lines
from service.replay.items import (
    AttitudeCarrier,
    Item,
    LineOutcome,
    OtherFiles,
    Pace,
    Problem,
    Report,
    reporting_to_carrier,
)

GIVE_UP_AFTER_S = 30.0


def replay_over_http(
    url: str,
    items: Iterable[Item],
    report: Report,
    pace: Pace | None = None,
    concurrency: int = 4,
    give_up_after_s: float = GIVE_UP_AFTER_S,
    token: str | None = None,
    watched_run: str | None = None,
    carrier: AttitudeCarrier | None = None,
) -> None:
    """Post every line to the service at `url` and report its outcome, in order.

    With a `carrier` each batch waits for the answer to the one before.  Raises `BadInput` for an
    invalid address, `Unauthenticated` where the service does not accept `token`, `Busy` when no
    service answers at first, or none for `give_up_after_s` later.  `watched_run` is a run whose
    limits are to be evaluated.
    """
    client = AsyncClient(checked_url(url), token, give_up_after_s=give_up_after_s)
    if carrier is not None:
        report, concurrency = reporting_to_carrier(report, carrier), 1
    with translated(url):
        asyncio.run(
            _replay(client, url, items, report, pace or Pace(), concurrency, watched_run, carrier)
        )


def checked_url(url: str) -> str:
    """Address of a service without a slash at its end; raises `BadInput` for an invalid one."""
    try:
        checked_address(url)
    except ValueError:
        message = "must be the address of a service, such as http://127.0.0.1:8000"
        raise errors.BadInput(errors.Fault("--url", message, errors.shown_value(url))) from None
    return url.rstrip("/")


@contextmanager
def translated(url: str) -> Iterator[None]:
    """Context that converts the client's exceptions to the service's errors, with remedies."""
    try:
        yield
    except answers.Unauthenticated as error:
        raise errors.Unauthenticated(
            f"{url} asks for a token ({error}): set ACQUIRE_TOKEN to one of its "
            "`acquire token create`"
        ) from None
    except answers.Forbidden as error:
        raise errors.Forbidden(f"{url}: {error}") from None
    except answers.NotFound as error:
        raise errors.NotFound(f"{url}: {error}") from None
    except (answers.BadInput, answers.Conflict, answers.WrongState) as error:
        raise errors.BadInput(errors.Fault("replay", str(error))) from None
    except answers.ClientError as error:
        raise errors.Busy(
            f"{url} no longer answers ({error}); run the same command again to go on "
            "from here: nothing is recorded twice"
        ) from None


def no_service(url: str, error: answers.NoAnswer) -> errors.Busy:
    """Error for an address where no service has ever answered."""
    return errors.Busy(
        f"no service answers at {url} ({error}); "
        "start one with `acquire serve`, or replay with --in-process"
    )


async def _replay(
    client: AsyncClient,
    url: str,
    items: Iterable[Item],
    report: Report,
    pace: Pace,
    concurrency: int,
    watched_run: str | None,
    carrier: AttitudeCarrier | None,
) -> None:
    async with client:
        await _require_service(client, url)
        if watched_run is not None:
            await _watch(client, watched_run)
        clock = asyncio.get_running_loop().time
        window: deque[asyncio.Task[LineOutcome]] = deque()
        try:
            for item in items:
                while (wait_s := pace.wait_s(item, clock())) > 0:
                    while window and window[0].done():
                        report(await window.popleft())
                    await asyncio.sleep(min(wait_s, 0.5))
                # A batch that asks for the last attitude waits for the answers before it.
                while len(window) >= (1 if _is_tracked(item) else concurrency):
                    report(await window.popleft())
                if carrier is not None:
                    item = carrier.prepared(item)
                window.append(asyncio.create_task(_outcome(client, item)))
            while window:
                report(await window.popleft())
        finally:
            for task in window:
                task.cancel()
            await asyncio.gather(*window, return_exceptions=True)


def _is_tracked(item: Item) -> bool:
    return item.submission is not None and item.submission.batch.tracking is not None


async def _require_service(client: AsyncClient, url: str) -> None:
    try:
        await client.ping()
    except answers.NoAnswer as error:
        raise no_service(url, error) from None
    except answers.UnexpectedAnswer as error:
        raise errors.Busy(str(error)) from None
    await client.session()


async def _watch(client: AsyncClient, run: str) -> None:
    try:
        await client.watch_run(run)
    except answers.Problem as problem:
        raise errors.BadInput(errors.Fault("--alarms", problem.detail, run)) from None


async def _outcome(client: AsyncClient, item: Item) -> LineOutcome:
    if item.problem is not None:
        return LineOutcome(item, None, problem=item.problem)
    try:
        recorded = await _submitted(client, item)
    except answers.Busy:
        raise
    except answers.Problem as problem:
        return LineOutcome(item, None, problem=_problem(problem))
    return LineOutcome(item, recorded.body, recorded.replayed)


async def _submitted(client: AsyncClient, item: Item) -> RecordedAnswer:
    if item.submission is not None:
        return await client.submit_json(item.submission.text)
    block = item.gyro
    assert block is not None
    path = path_of("spacecraft", block.spacecraft, "gyro")
    body = json_of_block(block)
    response = await client.request("POST", path, body=body, repeat=Repeat.ALWAYS)
    return RecordedAnswer(response.content, response.headers.get("Replayed") == "true")


def _problem(problem: answers.Problem) -> Problem:
    """Part of a problem that does not depend on the way in which the batch was sent."""
    if not problem.errors:
        return {"detail": problem.detail}
    faults = [errors.Fault(each.field, each.message, each.value) for each in problem.errors]
    return {**errors.problem_of_faults(faults), "detail": problem.detail}


# Replay through a running service as one upload, and poll its progress.
#
# Lines of telemetry are sent as NDJSON, other files in the form of the feature that reads them.
#
# Suited to files of any length: no single answer is waited for.  Repeating a replay
# adds nothing, as with single posts.

TIMEOUT_S = 120.0


class _SentLines:
    """Lines of files as sent to the service, with their places in the files."""

    def __init__(self, files: Sequence[Path], report: Report) -> None:
        self._files = files
        self._report = report
        self._places = array("L")
        self._starts: list[int] = []

    def __iter__(self) -> Iterator[bytes]:
        for file in self._files:
            self._starts.append(len(self._places))
            for line in read_lines(file):
                if line.body is None:
                    assert line.fault is not None
                    problem = errors.problem_of_faults([line.fault])
                    self._report(LineOutcome(Item(file, line.number, None), None, problem=problem))
                    continue
                self._places.append(line.number)
                yield line.body + b"\n"

    def item(self, number: int) -> Item:
        """File and line from which the sent line `number` came."""
        index = number - 1
        which = max(i for i, start in enumerate(self._starts) if start <= index)
        return Item(self._files[which], self._places[index], None)


def replay_in_bulk(
    url: str,
    files: Sequence[Path] | OtherFiles,
    run: str,
    report: Report,
    progress: Callable[[Replay], object],
    *,
    token: str | None = None,
    alarms: bool = False,
) -> None:
    """Send files as one replay and follow it to its end.

    `progress` receives the state of the replay repeatedly and at the end; `report` receives every
    refused line, those beyond the first thousand without their place.  Raises `BadInput`,
    `Unauthenticated`, `Forbidden` for a refusal by the service, `NotFound` where it no longer knows
    the replay, and `Busy` where it does not answer or stopped early.  An interruption cancels the
    replay on the service.
    """
    lines = _SentLines(files, report) if isinstance(files, Sequence) else files
    spacecraft = None if isinstance(lines, _SentLines) else lines.spacecraft
    with (
        translated(url),
        Client(
            checked_url(url), token, timeout_s=TIMEOUT_S, give_up_after_s=GIVE_UP_AFTER_S
        ) as client,
    ):
        try:
            begun = client.start_replay(
                lines,
                run,
                alarms=alarms,
                packets=not isinstance(lines, _SentLines),
                spacecraft=spacecraft,
            )
        except answers.NoAnswer as error:
            raise no_service(url, error) from None
        except answers.Busy as problem:
            raise errors.Busy(f"{url}: {problem}") from None
        try:
            for state in client.follow_replay(begun.id):
                progress(state)
        except KeyboardInterrupt:
            # A second Ctrl-C, or a service that is gone, must not be delayed by this request.
            with (
                suppress(answers.ClientError),
                Client(url, token, timeout_s=10.0, give_up_after_s=0.0) as canceller,
            ):
                canceller.cancel_replay(begun.id)
            raise
    for each in state.errors:
        report(LineOutcome(lines.item(each.line), None, problem=to_builtins(each.problem)))
    if state.state != "done":
        raise errors.Busy(
            f"{url} ended the replay before its end ({state.state}, "
            f"{state.lines.done} lines in); run the same command again to go on from "
            "here: nothing is recorded twice"
        )
