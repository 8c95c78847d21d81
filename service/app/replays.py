"""Replays: telemetry files worked through in the background."""

import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import IO, TypedDict, Unpack

from sqlalchemy import Connection

from service.access.audit import Entry
from service.access.tokens import Caller
from service.app.context import Context, checked_run_name, known_id
from service.app.submissions import Submissions
from service.errors import AcquisitionError, Busy, NotFound, Stopping
from service.ingest.bulk import Bulk, Check
from service.ingest.local_workers import WorkerConfig
from service.ingest.replays import (
    Replay,
    list_replays,
    mark_cancelled,
    read_replay,
    read_replay_row,
    require_cancellable,
)
from service.ingest.spool import Spool, SpooledReplay
from service.observations.readers.decompress import Coding, unpacked_lines
from service.storage.recording.ids import unguessable_ulid
from service.storage.recording.results import set_run_alarms
from service.storage.recording.unsaved_result import Row
from service.times import utc_now

log = logging.getLogger(__name__)

MAX_REPLAYS, MAX_OF_ONE_TOKEN = 8, 4
"""Each keeps a thread and a file of its own."""
REPLAY_RETRY_S = 30
CANCEL_WAIT_S = 5.0
"""The longest that cancelling waits for the end of a replay."""


class ReplayOptions(TypedDict, total=False):
    """What a replay may be started with."""

    name: str
    total: int | None
    """The number of lines, where it is known."""
    check: Check
    """Raises the `AcquisitionError` that refuses a line of that spacecraft."""
    alarms: bool
    """Evaluate limits for the run; see `Runs.watch`."""
    owner: str | None
    """The token that starts the replay; see `cancel`."""
    entry: Entry | None
    """The entry of the audit list that is stored with it."""


class Replays:
    """Starts, cancels and reports replays."""

    def __init__(self, context: Context, submissions: Submissions) -> None:
        self._context = context
        config = WorkerConfig(
            context.missions,
            context.settings.catalog,
            context.sky.catalog.digest,
            context.settings.shelf_mb << 20,
        )
        self.bulk = Bulk(
            submissions.ingest, context.store, config, context.settings.replay_processes
        )
        self._spool = Spool(context.settings.spool_folder)
        self._lock = threading.Lock()
        self._replays: list[Replay] = []
        self._closing = False

    @property
    def at_work(self) -> list[Replay]:
        """The replays that are not over."""
        return [each for each in self._replays if not each.is_over]

    def start(self, lines: Iterable[bytes], run: str, **options: Unpack[ReplayOptions]) -> str:
        """Work through NDJSON lines in the background; returns the id of the replay.

        Every batch goes to `run`.  Lines that can be closed are closed at the end.
        """
        replay = self._new(run, options)
        replay.start(lines, _noted_with(run, options))
        return replay.id

    def new_upload(self, caller: Caller) -> IO[bytes]:
        """A file for an upload; raises `Busy` where the caller can start no replay now."""
        self._require_slot(caller.token_id)
        return self._spool.new_file()

    def start_upload(
        self,
        file: IO[bytes],
        coding: Coding,
        run: str,
        longest_bytes: int,
        caller: Caller,
        **options: Unpack[ReplayOptions],
    ) -> str:
        """`start` with the lines of an upload, which is stored until the replay is over.

        Of a line with more than `longest_bytes` the rest is not read.
        """
        bound = None if caller.spacecraft is None else sorted(caller.spacecraft)
        options |= {"check": caller.require, "owner": caller.token_id}
        with ExitStack() as on_failure:
            on_failure.callback(discard_upload, file)
            replay = self._new(run, options, drop=self._spool.drop)
            on_failure.callback(replay.give_up)
            about = SpooledReplay(
                replay.id, coding, longest_bytes, caller.token_id, caller.name, bound
            )
            on_failure.callback(self._spool.drop, replay.id)
            self._spool.keep(file, about)
            file.seek(0)
            replay.start(_lines_of(file, about, replay), _noted_with(run, options))
            on_failure.pop_all()
        return replay.id

    def resume(self) -> None:
        """Go on with the uploads that an earlier process has not finished."""
        for about in self._spool.left():
            try:
                self._resume(about)
            except (AcquisitionError, OSError) as error:
                log.warning("replay %s does not go on: %s", about.id, error)
                self._spool.release(about.id)

    def _resume(self, about: SpooledReplay) -> None:
        with self._context.reading() as connection:
            row = read_replay_row(connection, about.id)
        if row is None or row["state"] not in ("running", "interrupted"):
            self._spool.drop(about.id)
            return
        bound = None if about.spacecraft is None else frozenset(about.spacecraft)
        caller = Caller(about.caller, frozenset(), bound, about.owner)
        options: ReplayOptions = {"check": caller.require, "owner": about.owner}
        file = self._spool.open(about.id)
        replay = self._new(row["run"], options, row, self._spool.drop)
        log.info("replay %s goes on after line %d", about.id, row["lines_done"])
        replay.resume(_lines_of(file, about, replay))

    def _new(
        self,
        run: str,
        options: ReplayOptions,
        row: Row | None = None,
        drop: Callable[[str], object] = lambda id: None,
    ) -> Replay:
        """A replay that takes a slot; `drop` is called when it is over and will not be resumed."""
        # Knowing the id is enough to read the progress.
        row = row or {
            "id": unguessable_ulid(),
            "run": checked_run_name(run),
            "name": options.get("name", "replay"),
            "lines_total": options.get("total"),
        }

        def ended(state: str) -> None:
            self._spool.release(str(row["id"]))
            if state != "interrupted":
                drop(str(row["id"]))

        replay = Replay(
            self._context.store,
            self.bulk,
            lambda: utc_now().text,
            row,
            options.get("check", lambda spacecraft: None),
            options.get("owner"),
            self._context.settings.replay_seconds,
            ended,
        )
        with self._lock:
            if self._closing:
                raise Stopping("the service is stopping")
            self._require_slot(options.get("owner"))
            self._replays = [*self.at_work, replay]
        return replay

    def _require_slot(self, owner: str | None) -> None:
        at_work = self.at_work
        if len(at_work) >= MAX_REPLAYS:
            raise Busy(f"{len(at_work)} replays are running", REPLAY_RETRY_S)
        own = sum(each.owner == owner for each in at_work)
        if owner is not None and own >= MAX_OF_ONE_TOKEN:
            raise Busy(f"{own} replays of this token are running", REPLAY_RETRY_S)

    def cancel(self, id: str, caller: Caller | None = None) -> Row:
        """End a replay; what it recorded stays.  Returns how far it came.

        Waits a few seconds for its end, until when its state is `running`.  A
        replay that is cancelled already is left as it is.  Raises `NotFound`,
        also where the caller is bound to spacecraft and the replay was not
        started with their token, and `WrongState` where it has ended otherwise.
        """
        known = known_id(id, "replay")
        with self._lock:
            replay = next((each for each in self._replays if each.id == known), None)
        is_bound = caller is not None and caller.spacecraft is not None
        if caller is not None and is_bound and (not replay or replay.owner != caller.token_id):
            raise NotFound(f"{caller.name} has started no replay with the id {id[:80]!r}")
        if replay is None:
            moment = utc_now().text
            self._context.change(lambda connection: mark_cancelled(connection, known, moment))
        elif not replay.is_over:
            replay.cancel()
            replay.wait(CANCEL_WAIT_S)
        state = self.get(known)
        require_cancellable(state["state"])
        return state

    def all(self) -> list[Row]:
        """The latest replays and their progress, newest first."""
        with self._context.reading() as connection:
            return list_replays(connection)

    def get(self, id: str) -> Row:
        """A replay and how far it is, with the lines that were refused."""
        with self._context.reading() as connection:
            return read_replay(connection, known_id(id, "replay"))

    def processes(self) -> int:
        """How many processes beside this one are ready to compute replays."""
        return self.bulk.workers.up

    def stop(self) -> None:
        """Stop every replay; none starts from now on."""
        with self._lock:
            self._closing = True
        for replay in self._replays:
            replay.stop()
        self.bulk.close()
        for replay in self._replays:
            replay.wait()


def discard_upload(file: IO[bytes]) -> None:
    """Remove an upload of which no replay is started."""
    file.close()
    Path(file.name).unlink(missing_ok=True)


def _lines_of(file: IO[bytes], about: SpooledReplay, replay: Replay) -> Iterable[bytes]:
    return unpacked_lines(file, about.coding, about.longest_bytes, replay.require_going_on)


def _noted_with(run: str, options: ReplayOptions) -> Callable[[Connection], None]:
    """What is stored in the transaction that notes a replay."""

    def store(connection: Connection) -> None:
        if options.get("alarms"):
            set_run_alarms(connection, run, True, utc_now().text)
        entry = options.get("entry")
        if entry is not None:
            entry.add_to(connection)

    return store
