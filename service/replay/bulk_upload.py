"""Replay through a running service as one upload, and poll its progress.

Lines of telemetry are sent as NDJSON, files of space packets with their XTCE file as an archive.

Suited to files of any length: no single answer is waited for.  Repeating a replay
adds nothing, as with single posts.
"""

from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from acquire_client import Client
from acquire_client import errors as answers
from acquire_client.models import Replay
from msgspec import to_builtins

from service.errors import Busy, problem_of_faults
from service.observations.readers.telemetry import read_lines
from service.packets.upload import archive_of
from service.replay.items import Item, LineOutcome, Report
from service.replay.over_http import GIVE_UP_AFTER_S, checked_url, no_service, translated

TIMEOUT_S = 120.0
CANCEL_S = 10.0


class _SentLines:
    """The lines of files as they are sent, with the place of each."""

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
    progress: Callable[[Replay], object],
    *,
    token: str | None = None,
    alarms: bool = False,
    spacecraft: str | None = None,
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
    with (
        translated(url),
        Client(
            checked_url(url), token, timeout_s=TIMEOUT_S, give_up_after_s=GIVE_UP_AFTER_S
        ) as client,
    ):
        try:
            begun = client.start_replay(
                lines, run, alarms=alarms, packets=xtce is not None, spacecraft=spacecraft
            )
        except answers.NoAnswer as error:
            raise no_service(url, error) from None
        except answers.Busy as problem:
            raise Busy(f"{url}: {problem}") from None
        try:
            for state in client.follow_replay(begun.id):
                progress(state)
        except KeyboardInterrupt:
            # A second Ctrl-C, or a service that is gone, must not wait for this.
            with (
                suppress(answers.ClientError),
                Client(url, token, timeout_s=CANCEL_S, give_up_after_s=0.0) as canceller,
            ):
                canceller.cancel_replay(begun.id)
            raise
    for each in state.errors:
        report(LineOutcome(lines.item(each.line), None, problem=to_builtins(each.problem)))
    if state.state != "done":
        raise Busy(
            f"{url} ended the replay before its end ({state.state}, "
            f"{state.lines.done} lines in); run the same command again to go on from "
            "here: nothing is recorded twice"
        )
