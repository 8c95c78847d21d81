"""Client of the service: batches, runs, replays and all other parts, and live events."""

import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Literal, overload

import httpx

from .. import models
from ..encoding import Batch, Query, decoded, path_of, pieces_of
from ..errors import Busy, EventsLost, Problem, ReplayEnded
from ..event_lines import Block, BlockReader, Event
from ..methods import Methods
from ..operations import BatchOutcome, Results
from ..retrying import Patience, Repeat
from .backend import Source, bounded_map, iterated, sleep
from .connection import Connection


class Batches(Results, Connection):
    """Client methods for submitting many batches, and for what-ifs."""

    def submit_many(self, batches: Source[Batch], *, at_once: int = 8) -> Iterator[BatchOutcome]:
        """Submit batches as they are taken from `batches`, at most `at_once` at a time.

        The outcomes come in the same order: an answer, or the problem of a batch that was
        refused.  Where batches come slowly, `submit` each: an outcome may wait for the next batch.
        For whole files, `replay` is faster.

        >>> [outcome.problem for outcome in client.submit_many([batch, batch])]
        [None, None]
        """
        yield from bounded_map(self._outcome, batches, at_once)

    def _outcome(self, batch: Batch) -> BatchOutcome:
        try:
            recorded = self.submit_json(batch)
        except Problem as problem:
            return BatchOutcome(batch, None, problem)
        return BatchOutcome(batch, recorded, None)

    @overload
    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: Literal[True]
    ) -> models.Answer: ...

    @overload
    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: Literal[False] = False
    ) -> models.WhatIf: ...

    @overload
    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: bool
    ) -> models.Answer | models.WhatIf: ...

    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: bool = False
    ) -> models.Answer | models.WhatIf:
        """Process a recorded batch again with other options; `record` stores the result as well.

        >>> latest = client.latest("XTE")
        >>> votes = client.what_if(latest.answer.id, {"identifier": "starid"})
        >>> votes.counts.ambiguous, votes.id
        (1, None)
        """
        body = {"options": dict(options), "record": record}
        path = path_of("batches", id, "what-if")
        if record:
            return self.post(models.Answer, path, body)
        return self.post(models.WhatIf, path, body, Repeat.ALWAYS)


NDJSON = "application/x-ndjson"
PACKETS = "application/x-tar"
POLL_S = 0.25
INTERRUPTED_FOR_S = 20.0
"""Seconds for which a replay may be interrupted before it counts as ended.

A service that starts marks every replay as interrupted; a process that still works on one corrects
that with its next lines, which a busy machine may delay.
"""


class Replays(Connection):
    """Client methods for replays of telemetry files."""

    def replay(
        self,
        lines: Path | bytes | Source[bytes],
        run: str,
        *,
        alarms: bool = False,
        packets: bool = False,
        spacecraft: str | None = None,
        progress: Callable[[models.Replay], object] = lambda replay: None,
    ) -> models.Replay:
        """Send a telemetry file as one replay and follow it to its end.

        `progress` is called with each state.  A file that is sent twice is recorded once.  Raises
        `ReplayEnded` where the replay fails or is cancelled.  For the other arguments see
        `start_replay`.

        >>> done = client.replay(Path("pass.ndjson"), "pass-1")
        >>> done.lines.done, done.counts.new, [each.line for each in done.errors]
        (2, 1, [2])
        """
        begun = self.start_replay(lines, run, alarms=alarms, packets=packets, spacecraft=spacecraft)
        state = begun
        for state in self.follow_replay(begun.id):
            progress(state)
        if state.state != "done":
            raise ReplayEnded(state)
        return state

    def start_replay(
        self,
        lines: Path | bytes | Source[bytes],
        run: str,
        *,
        alarms: bool = False,
        packets: bool = False,
        spacecraft: str | None = None,
    ) -> models.Replay:
        """Send a telemetry file as one replay, which the service processes in the background.

        `lines` is a file, or its bytes in one or many pieces: NDJSON, or with `packets` a tar
        archive of space packets and their XTCE file; `spacecraft` names their mission.  `run` gets
        every batch; `alarms` switches the evaluation of its limits on.
        """
        content = pieces_of(lines) if isinstance(lines, Path) else lines
        response = self.request(
            "POST",
            path_of("replays"),
            query={"run": run, "alarms": alarms or None, "spacecraft": spacecraft},
            content=content if isinstance(content, bytes) else iterated(content),
            headers={"Content-Type": PACKETS if packets else NDJSON},
            # Pieces can be read only once, and a second replay would repeat the work.
            repeat=Repeat.NEVER,
        )
        return decoded(response, models.Replay)

    def follow_replay(self, id: str, *, every_s: float = POLL_S) -> Iterator[models.Replay]:
        """States of a replay until its end; the last one has the final state.

        Waits through a restart of the service.
        """
        running_s = time.monotonic()
        while True:
            state = self.get(models.Replay, path_of("replays", id))
            yield state
            if state.state in ("running", "waiting"):
                running_s = time.monotonic()
            elif state.state != "interrupted" or time.monotonic() - running_s > INTERRUPTED_FOR_S:
                return
            sleep(every_s)


SILENCE_S = 45.0
"""Seconds of silence after which an event stream counts as lost; the service sends every 15."""


class Events:
    """Live events, as an iterator without gaps or repetitions.

    `last` is the number of the latest event returned, or named as the latest by the service;
    iterating again, or `events(after=last)` of another client, continues after it.  None: nothing
    was received yet.
    """

    def __init__(self, connection: Connection, query: Query, after: int | None) -> None:
        self._connection, self._query = connection, query
        self.last = after

    def __iter__(self) -> Iterator[Event]:
        patience = Patience(self._connection.give_up_after_s)
        while True:
            try:
                with closing(self._blocks()) as blocks:
                    for block in blocks:
                        patience.answered()
                        if (event := self._taken(block)) is not None:
                            patience.progressed()
                            yield event
                # The service ends every stream after a time, and when it stops.
                wait_s = patience.after_end()
            except Busy as problem:
                wait_s = patience.after_problem(problem)
            except httpx.RequestError as error:
                wait_s = patience.after_loss(error, self._connection.url)
            sleep(wait_s)

    def _blocks(self) -> Generator[Block, None, None]:
        headers = {} if self.last is None else {"Last-Event-ID": str(self.last)}
        path, reader = path_of("events"), BlockReader()
        with self._connection.stream(path, self._query, headers, SILENCE_S) as pieces:
            for piece in pieces:
                yield from reader.feed(piece)

    def _taken(self, block: Block) -> Event | None:
        """Event in a block, None for a block without one; raises `EventsLost` for a reset."""
        if block.kind == "reset" and block.id is not None:
            after, self.last = self.last, block.id
            raise EventsLost(after, block.id)
        if block.kind == "hello" or block.data is None:
            self.last = block.id if block.id is not None else self.last
            return None
        event = block.event()
        self.last = event.id
        return event


class Client(Batches, Replays, Methods):
    """Client of the service at an address; a context manager that closes its connections.

    `token` is sent with each request.  A request that may be repeated is sent again after a lost
    connection, and where the service asks for it, until the service has not answered for
    `give_up_after_s`.  `timeout_s` bounds the wait for the next part of an answer.  `trust_env`
    uses the proxies that the environment names; `verify` is the context of TLS, or False to trust
    every certificate.

    Raises `InvalidArgument`, a `ValueError`, for an invalid address or token; every method raises
    `NoAnswer` and the `Problem` of the service's answer.
    """

    def events(
        self, *, run: str | None = None, spacecraft: str | None = None, after: int | None = None
    ) -> Events:
        """Live events from now on, or from after the event with the number `after`.

        They are followed through lost connections and restarts of the service.  Raises
        `EventsLost` where the service no longer keeps all that were missed, `NoAnswer` where it
        does not come back for `give_up_after_s`.

        >>> for event in client.events(after=0):
        ...     if event.kind == "batches":
        ...         print(event.id, event.data.latest.batch)
        ...         break
        1 1996-010-0110
        """
        return Events(self, {"run": run, "spacecraft": spacecraft}, after)
