"""Replay through a running service as one upload, and poll its progress.

Lines of telemetry are sent as NDJSON, files of space packets with their XTCE file as an archive.

Suited to files of any length: no single answer is waited for.  Repeating a replay
adds nothing, as with single posts.
"""

import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx

from service.errors import (
    BadInput,
    Busy,
    Fault,
    Forbidden,
    NotFound,
    Unauthenticated,
    problem_of_faults,
)
from service.observations.readers.telemetry import read_lines
from service.packets.upload import MEDIA_TYPE, archive_of
from service.replay.items import Item, LineOutcome, Problem, Report
from service.replay.over_http import GIVE_UP_AFTER_S, checked_url, shown_error

ROUTE = "/api/v1/replays"
NDJSON = {"Content-Type": "application/x-ndjson"}
ARCHIVE = {"Content-Type": MEDIA_TYPE}
TIMEOUT = httpx.Timeout(120.0, connect=5.0)
PAUSE_S = 0.25
CANCEL_S = 10.0
INTERRUPTED_FOR_S = 5.0
"""A starting process marks every replay as interrupted; another process that still works on one
corrects that with its next lines."""

ReplayState = dict[str, Any]


class _SentLines:
    """The lines of files as they are sent, with the place of each."""

    headers = NDJSON

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
                    problem = problem_of_faults([line.fault])
                    self._report(LineOutcome(Item(file, line.number, None), None, problem=problem))
                    continue
                self._places.append(line.number)
                yield line.body + b"\n"

    def item(self, number: int) -> Item:
        """The file and line that sent line `number` came from."""
        index = number - 1
        which = max(i for i, start in enumerate(self._starts) if start <= index)
        return Item(self._files[which], self._places[index], None)


class _SentPackets:
    """Files of packets and their XTCE file as they are sent."""

    headers = ARCHIVE

    def __init__(self, files: Sequence[Path], xtce: Path) -> None:
        self._files, self._xtce = files, xtce

    def __iter__(self) -> Iterator[bytes]:
        return archive_of([self._xtce, *self._files])

    def item(self, number: int) -> Item:
        """A packet by its number; of several files the problem names the one."""
        return Item(self._files[0], number, None)


def replay_in_bulk(
    url: str,
    files: Sequence[Path],
    run: str,
    report: Report,
    progress: Callable[[ReplayState], None],
    *,
    token: str | None = None,
    query: dict[str, str] | None = None,
    xtce: Path | None = None,
) -> None:
    """Send files as one replay and follow it to its end.

    With `xtce` they are files of space packets that this file describes.

    `progress` receives the state of the replay repeatedly and at the end;
    `report` receives every refused line, those beyond the first thousand without
    their place.  Raises `BadInput`, `Unauthenticated`, `Forbidden` for what the service
    refuses, `NotFound` where it no longer knows the replay, and `Busy` where it
    does not answer or stopped early.  Interrupted, it has the service
    cancel the replay.
    """
    lines = _SentLines(files, report) if xtce is None else _SentPackets(files, xtce)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    with httpx.Client(
        base_url=checked_url(url), timeout=TIMEOUT, trust_env=False, headers=headers
    ) as client:
        begun = _begin(client, url, {"run": run, **(query or {})}, lines)
        try:
            state = _follow(client, url, begun, progress)
        except KeyboardInterrupt:
            # A second Ctrl-C, or a service that is gone, must not wait for this.
            with suppress(httpx.HTTPError):
                client.delete(begun, timeout=CANCEL_S)
            raise
    for each in state["errors"]:
        report(LineOutcome(lines.item(each["line"]), None, problem=each["problem"]))
    if state["state"] != "done":
        raise Busy(
            f"{url} ended the replay before its end ({state['state']}, "
            f"{state['lines']['done']} lines in); run the same command again to go on from "
            "here: nothing is recorded twice"
        )


def _begin(
    client: httpx.Client, url: str, query: dict[str, str], lines: _SentLines | _SentPackets
) -> str:
    try:
        response = client.post(ROUTE, params=query, content=iter(lines), headers=lines.headers)
    except httpx.TransportError as error:
        raise Busy(
            f"no service answers at {url} ({shown_error(error)}); "
            "start one with `acquire serve`, or replay with --in-process"
        ) from None
    if response.status_code == 202:
        return str(response.headers["Location"])
    _require_authorized(response, url)
    detail = str(_problem(response)["detail"])
    if response.status_code >= 500:
        raise Busy(f"{url}: {detail}")
    raise BadInput(Fault("replay", detail))


def _require_authorized(response: httpx.Response, url: str) -> None:
    detail = str(_problem(response)["detail"]) if response.is_error else ""
    if response.status_code == 401:
        raise Unauthenticated(f"{url} asks for a token ({detail}): set ACQUIRE_TOKEN")
    if response.status_code == 403:
        raise Forbidden(f"{url}: {detail}")


def _follow(
    client: httpx.Client, url: str, place: str, progress: Callable[[ReplayState], None]
) -> ReplayState:
    deadline = time.monotonic() + GIVE_UP_AFTER_S
    running_s = time.monotonic()
    while True:
        try:
            response = client.get(place)
            if response.status_code == 200:
                state: ReplayState = response.json()
                progress(state)
                if state["state"] == "running":
                    running_s = time.monotonic()
                elif (
                    state["state"] != "interrupted"
                    or time.monotonic() - running_s > INTERRUPTED_FOR_S
                ):
                    return state
                deadline = time.monotonic() + GIVE_UP_AFTER_S
            # Asking again would not change these answers.
            _require_authorized(response, url)
            if response.status_code == 404:
                raise NotFound(f"{url}: {_problem(response)['detail']}")
        except httpx.TransportError:
            pass
        if time.monotonic() > deadline:
            raise Busy(
                f"{url} no longer answers; run the same command again to go on from here: "
                "nothing is recorded twice"
            )
        time.sleep(PAUSE_S)


def _problem(response: httpx.Response) -> Problem:
    try:
        content: Problem = response.json()
        return content if "detail" in content else {"detail": f"HTTP {response.status_code}"}
    except ValueError:
        return {"detail": f"HTTP {response.status_code}: {response.text[:200]}"}
