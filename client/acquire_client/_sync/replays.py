"""Runs, and replays of telemetry files into them."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from .. import models
from ..encoding import decoded, path_of, pieces_of
from ..errors import ReplayEnded
from ..retrying import Repeat
from .backend import Source, iterated, sleep
from .connection import Connection

NDJSON = "application/x-ndjson"
PACKETS = "application/x-tar"
POLL_S = 0.25
INTERRUPTED_FOR_S = 20.0
"""A service that starts marks every replay as interrupted; a process that still works on one
corrects that with its next lines, which a busy machine may take a while for."""


class Replays(Connection):
    """The part of the client that is about runs and replays."""

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
        """Send a telemetry file as one replay, which the service works on in the background.

        `lines` is a file, or its bytes in one or many pieces: NDJSON, or with `packets` a tar
        archive of space packets and their XTCE file; `spacecraft` names their mission.  `run`
        takes every batch; `alarms` raises alarms for it.
        """
        content = pieces_of(lines) if isinstance(lines, Path) else lines
        response = self.request(
            "POST",
            path_of("replays"),
            query={"run": run, "alarms": alarms or None, "spacecraft": spacecraft},
            content=content if isinstance(content, bytes) else iterated(content),
            headers={"Content-Type": PACKETS if packets else NDJSON},
            # Pieces can be read once only, and a second replay would do the same work.
            repeat=Repeat.NEVER,
        )
        return decoded(response, models.Replay)

    def follow_replay(self, id: str, *, every_s: float = POLL_S) -> Iterator[models.Replay]:
        """The states of a replay until it ends; the last one tells how.

        A restart of the service in between is waited for.
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
