"""Replays of telemetry files, processed in the background."""

import logging
import threading
from collections.abc import Callable, Collection, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, TypedDict, Unpack

from sqlalchemy import Connection

from service.access import Caller, Entry
from service.app.context import Context, checked_run_name, known_id
from service.contract.runs import Replay, ReplayCounts, ReplayLines
from service.errors import AcquisitionError, Busy, Fault, NotAvailable, NotFound, Stopping
from service.feature import SETTING, feature_modules
from service.ingest.bulk import Bulk, Check, RecordBlocks
from service.ingest.memory import require_memory_for_replay
from service.ingest.missions_in_force import MissionsInForce
from service.ingest.running_replay import CountedLines, RunningReplay
from service.ingest.spool import Spool, SpooledReplay
from service.ingest.submit import SubmissionService
from service.ingest.worker_process import WorkerConfig
from service.observations.decompress import Coding, Line, unpacked_lines
from service.observations.input_formats import NDJSON, input_formats
from service.observations.telemetry import is_utf16, read_lines, require_telemetry
from service.storage.queries import replay_rows
from service.storage.recording.ids import unguessable_ulid
from service.storage.recording.results import set_run_alarms
from service.times import utc_now

log = logging.getLogger(__name__)

MAX_REPLAYS, MAX_OF_ONE_TOKEN = 8, 4
"""Largest number of replays at a time, in all and by token; each needs a thread and a file."""
REPLAY_RETRY_S = 30
CANCEL_WAIT_S = 5.0
"""Longest wait of a cancellation for the end of the replay, in seconds."""


class ReplayOptions(TypedDict, total=False):
    """Options of a new replay of a telemetry file."""

    name: str
    total: int | None
    """Number of lines of the replay; None if not known."""
    check: Check
    """Function that raises an `AcquisitionError` for lines of a refused spacecraft."""
    alarms: bool
    """True to evaluate limits for the replay's run; see `Runs.watch`."""
    owner: str | None
    """Id of the token that starts the replay; see `cancel`."""
    entry: Entry | None
    """Entry of the audit list that is stored with the replay."""


@dataclass(frozen=True)
class UploadForm:
    """Form of an upload: its coding, format and size limit."""

    coding: Coding
    longest_bytes: int
    """Largest number of bytes in a line, which is cut there."""
    form: str = NDJSON
    """Name of the upload's format (`Replays.formats`)."""
    spacecraft: str | None = None
    """Mission for an upload of archived packets; None: the only mission that reads them."""


class Replays:
    """Service that starts, cancels and reports replays."""

    def __init__(
        self,
        context: Context,
        in_force: MissionsInForce,
        submissions: SubmissionService,
        record_blocks: RecordBlocks,
    ) -> None:
        self._context = context
        config = WorkerConfig(
            context.missions,
            context.settings.catalog,
            context.sky.catalog.digest,
            context.settings.shelf_mb << 20,
        )
        self.bulk = Bulk(
            submissions,
            record_blocks,
            context.store,
            config,
            context.settings.replay_processes,
        )
        in_force.when_changed(self.bulk.workers.restart)
        self._spool = Spool(context.settings.spool_folder)
        off = context.settings.features_off
        self._archives = {each.FORMAT: each for each in feature_modules("telemetry", off)}
        """Modules of features that read uploads without lines, by name of the format."""
        self.formats = {k: each for k, each in input_formats(off).items() if each.media_types}
        """Input formats accepted for uploads, by name."""
        self._lock = threading.Lock()
        self._replays: list[RunningReplay] = []
        self._given_up: set[str] = set()
        """Ids of replays that this process could not resume and will not try again."""
        self._closing = False

    @property
    def at_work(self) -> list[RunningReplay]:
        """Replays that have not ended."""
        return [each for each in self._replays if not each.is_over]

    def start(self, lines: Iterable[bytes], run: str, **options: Unpack[ReplayOptions]) -> str:
        """Start a replay of NDJSON lines in the background; returns its id.

        Every batch goes to `run`.  Lines that can be closed are closed at the end.
        """
        self._context.require_alarms(options.get("alarms", False))
        replay = self._new(run, options)
        replay.start(lines, _stored_with(run, options))
        return replay.id

    def new_upload(self, caller: Caller) -> IO[bytes]:
        """Create a file for an upload; raises `Busy` if the caller cannot start a replay now."""
        self._require_slot(caller.token_id)
        self._require_memory()
        return self._spool.new_file()

    def start_upload(
        self,
        file: IO[bytes],
        form: UploadForm,
        run: str,
        caller: Caller,
        **options: Unpack[ReplayOptions],
    ) -> str:
        """Start a replay of an uploaded file, which is stored until the replay is over.

        Raises `BadInput` for an archive that its feature refuses, and for CSV without the columns
        of a batch.
        """
        bound = None if caller.spacecraft is None else sorted(caller.spacecraft)
        options |= {"check": caller.require, "owner": caller.token_id}
        with ExitStack() as on_failure:
            on_failure.callback(discard_upload, file)
            self._context.require_alarms(options.get("alarms", False))
            archive = self._archive_lines(file, form)
            if archive is None and form.coding == "identity":
                file.flush()
                require_telemetry(Path(file.name), form.form, "body")
                if is_utf16(Path(file.name)):
                    # The newlines were counted as bytes.
                    options["total"] = None
            replay = self._new(run, options, drop=self._spool.drop)
            on_failure.callback(replay.release_slot)
            about = SpooledReplay(
                replay.id,
                form.coding,
                form.longest_bytes,
                caller.token_id,
                caller.name,
                bound,
                archive.spacecraft if archive else None,
                form=form.form,
            )
            on_failure.callback(self._spool.drop, replay.id)
            self._spool.keep(file, about)
            file.seek(0)
            lines = archive or self._lines_of(file, about, replay)
            replay.start(lines, _stored_with(run, options))
            on_failure.pop_all()
        return replay.id

    def resume(self) -> None:
        """Resume the uploads that an earlier process has not finished."""
        for about in self._spool.left():
            if about.id in self._given_up:
                self._spool.release(about.id)
                continue
            try:
                self._require_memory()
            except Busy as error:
                # Keep it in the spool: the replay itself may have ended the last process.
                log.warning("replay %s is not continued yet: %s", about.id, error)
                self._spool.release(about.id)
                continue
            try:
                self._resume(about)
            except (AcquisitionError, OSError) as error:
                log.warning("replay %s is not continued: %s", about.id, error)
                self._given_up.add(about.id)
                self._spool.release(about.id)
                close = partial(replay_rows.close_waiting, id=about.id, now=utc_now().text)
                self._context.change(close)

    def _resume(self, about: SpooledReplay) -> None:
        with self._context.reading_record() as connection:
            stored = replay_rows.find_replay(connection, about.id)
        if stored is None or stored.state not in (*replay_rows.UNFINISHED, "interrupted"):
            self._spool.drop(about.id)
            return
        bound = None if about.spacecraft is None else frozenset(about.spacecraft)
        caller = Caller(about.caller, frozenset(), bound, about.owner)
        options: ReplayOptions = {"check": caller.require, "owner": about.owner}
        file = self._spool.open(about.id)
        form = UploadForm(about.coding, about.longest_bytes, about.form_name, about.packets)
        try:
            # An archive that has become unreadable must not leave a replay that never ends.
            archive = self._archive_lines(file, form)
            replay = self._new(stored.run, options, stored, self._spool.drop)
        except BaseException:
            file.close()
            raise
        log.info("replay %s continues after line %d", about.id, stored.lines.done)
        replay.resume(archive or self._lines_of(file, about, replay))

    def _lines_of(
        self, file: IO[bytes], about: SpooledReplay, replay: RunningReplay
    ) -> Iterable[bytes | Line]:
        path = self._spool.path(about.id)
        is_plain_wide = about.coding == "identity" and is_utf16(path)
        if about.form_name == NDJSON and not is_plain_wide:
            return unpacked_lines(file, about.coding, about.longest_bytes, replay.require_going_on)
        file.close()
        return read_lines(path, about.form_name)

    def _archive_lines(self, file: IO[bytes], form: UploadForm) -> CountedLines | None:
        """Open an uploaded archive as lines of batches; None for an upload of lines.

        Raises `NotAvailable` where the feature that reads it has been switched off.
        """
        if form.form not in self.formats:
            message = f"no feature reads it; see {SETTING}"
            raise NotAvailable(Fault("body", message, form.form))
        if form.form not in self._archives:
            return None
        module, missions = self._archives[form.form], self._context.missions
        lines: CountedLines = module.opened_upload(file, missions, form.spacecraft)
        return lines

    def _new(
        self,
        run: str,
        options: ReplayOptions,
        stored: Replay | None = None,
        drop: Callable[[str], object] = lambda id: None,
    ) -> RunningReplay:
        """Create a replay in a free slot; `drop` is called at its end unless it can be resumed."""
        state = stored or _new_state(checked_run_name(run), options)

        def ended(end: str) -> None:
            self._context.store.at_work.discard(state.id)
            self._spool.release(state.id)
            if end != "interrupted":
                drop(state.id)

        replay = RunningReplay(
            self._context.store,
            self.bulk,
            lambda: utc_now().text,
            state,
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
            self._context.store.at_work.add(state.id)
        return replay

    def _require_slot(self, owner: str | None) -> None:
        at_work = self.at_work
        if len(at_work) >= MAX_REPLAYS:
            raise Busy(f"{len(at_work)} replays are running", REPLAY_RETRY_S)
        own = sum(each.owner == owner for each in at_work)
        if owner is not None and own >= MAX_OF_ONE_TOKEN:
            raise Busy(f"{own} replays of this token are running", REPLAY_RETRY_S)

    def _require_memory(self) -> None:
        workers = self.bulk.workers
        require_memory_for_replay(max(0, workers.count - workers.up))

    def cancel(self, id: str, caller: Caller | None = None) -> Replay:
        """Cancel a replay and return its progress; recorded batches stay.

        Waits a few seconds for its end, until when its state is `running`.  A replay that is
        cancelled already is left unchanged.  Raises `NotFound`, also where the caller is limited to
        spacecraft and the replay was not started with its token, and `WrongState` where it has
        ended otherwise.
        """
        known = known_id(id, "replay")
        with self._lock:
            replay = next((each for each in self._replays if each.id == known), None)
        is_bound = caller is not None and caller.spacecraft is not None
        if caller is not None and is_bound and (not replay or replay.owner != caller.token_id):
            raise NotFound(f"{caller.name} has started no replay with the id {id[:80]!r}")
        if replay is None:
            moment = utc_now().text
            self._context.change(
                lambda connection: replay_rows.mark_cancelled(connection, known, moment)
            )
        elif not replay.is_over:
            replay.cancel()
            replay.wait(CANCEL_WAIT_S)
        cancelled = self.get(known)
        replay_rows.require_cancellable(cancelled.state)
        return cancelled

    def all(self, spacecraft: Collection[str] | None = None) -> list[Replay]:
        """List the latest replays, newest first; for `spacecraft` see `list_replays`."""
        with self._context.reading() as connection:
            return replay_rows.list_replays(connection, spacecraft)

    def get(self, id: str) -> Replay:
        """Read a replay with its progress and its refused lines."""
        with self._context.reading_record() as connection:
            return replay_rows.read_replay(connection, known_id(id, "replay"))

    def processes(self) -> int:
        """Number of worker processes that are ready to compute replays."""
        return self.bulk.workers.up

    def stop(self) -> None:
        """Stop all replays; no further one starts."""
        with self._lock:
            self._closing = True
        for replay in self._replays:
            replay.stop()
        self.bulk.close()
        for replay in self._replays:
            replay.wait()


def _new_state(run: str, options: ReplayOptions) -> Replay:
    return Replay(
        # Knowing the id is enough to read the progress.
        id=unguessable_ulid(),
        run=run,
        name=options.get("name", "replay"),
        state="running",
        lines=ReplayLines(total=options.get("total"), done=0, refused=0),
        counts=ReplayCounts(**dict.fromkeys(ReplayCounts.__struct_fields__, 0)),
        packets=None,
        errors=[],
        started=utc_now().text,
        finished=None,
    )


def discard_upload(file: IO[bytes]) -> None:
    """Delete an upload for which no replay was started."""
    file.close()
    Path(file.name).unlink(missing_ok=True)


def _stored_with(run: str, options: ReplayOptions) -> Callable[[Connection], None]:
    """Function that stores a new replay's alarm setting and audit entry, in its transaction."""

    def store(connection: Connection) -> None:
        if options.get("alarms"):
            set_run_alarms(connection, run, True, utc_now().text)
        entry = options.get("entry")
        if entry is not None:
            entry.add_to(connection)

    return store
