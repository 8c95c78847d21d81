"""Open database with one writer and many readers."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import Connection

from service import logs
from service.storage.archived import open_archive
from service.storage.progress import Progress
from service.storage.readers import Readers
from service.storage.recording.events import HeardEvents
from service.storage.recording.writer import Writer, remove_probe
from service.storage.sql import engines
from service.storage.sql.database_file import FileLock
from service.storage.sql.migrations import (
    bring_up_to_date,
    disposed,
    require_known_file,
    require_up_to_date,
)
from service.storage.sql.projector_lock import ProjectorLock


class Store(Readers):
    """Open database: one writing connection with its thread, and a pool of reading connections."""

    def __init__(
        self,
        database: str,
        *,
        create: bool = True,
        serving: bool = False,
        archive_folder: Path | None = None,
        features_off: str = "",
    ) -> None:
        """Open a database: a writable SQLite file is created and migrated, others must be current.

        Without `create` SQLite's file must exist.  Batches that left the database are read from the
        `archive_folder`.

        One process at a time writes to a SQLite file, from its first write on; with `serving`, from
        the start.  `serving` bounds the waiting times, too, see `Readers`, and on PostgreSQL lets
        one service alone project.

        Features listed in `features_off` project nothing, and read no archive.

        Raises `BadConfiguration` with the remedy.
        """
        self.features_off = features_off
        self.archive = open_archive(archive_folder, features_off)
        url = engines.database_url(database)
        file = engines.database_file(url)
        if file is not None and not create:
            file.require_there()
        require_known_file(url)
        timeouts = engines.TO_COMMIT if serving else None
        self.file_lock = None if file is None else FileLock(file)
        """Lock of the SQLite file against other writing processes; None on a server."""
        self._writing = engines.writing_engine(url, file=file, create=create, timeouts=timeouts)
        try:
            if self.file_lock is None:
                require_up_to_date(self._writing)
            else:
                if serving:
                    self.require_writing()
                if file is not None and file.is_read_only:
                    with disposed(engines.reading_engine(url)) as engine:
                        require_up_to_date(engine)
                else:
                    bring_up_to_date(self._writing, self.file_lock.take)
        except BaseException:
            self._writing.dispose()
            if self.file_lock is not None:
                self.file_lock.release()
            raise
        super().__init__(database, serving=serving, file=file)
        self.lock = ProjectorLock() if serving and file is None else None
        """Projector's lock on PostgreSQL, without which nothing is projected; None on SQLite."""
        wait_s = engines.LONGEST_WAIT_S if serving else None
        self.at_work = set[str]() if self.lock is None else self.lock.at_work
        """Ids of the replays and calibrations that run in this process."""
        self.writer = Writer(
            self._writing, file=file, wait_s=wait_s, lock=self.lock, file_lock=self.file_lock
        )
        self.progress = Progress(self, self.writer)
        """Progress of the projections, which readers wait for."""
        self._heard: HeardEvents | None = None
        if serving and self.file_lock is not None:
            self.writer.change(remove_probe)
        elif serving:
            self._heard = HeardEvents(self.url, self.writer.bell)

    @property
    def is_projecting(self) -> bool:
        """True if this process projects, to its own knowledge, without asking the database."""
        return self.lock is None or self.lock.is_held

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Context manager of a connection that sees the projections of everything recorded so far.

        The wait is at most a second: see `Progress.wait`.  A remaining lag is noted for the answer
        of the request.
        """
        behind_s = self.progress.wait()
        if behind_s and (request := logs.request.get()) is not None:
            request.behind_s = behind_s
        with self.reading_record() as connection:
            yield connection

    @contextmanager
    def reading_batch(self, id: str) -> Iterator[tuple[Connection, bool]]:
        """Context manager of a connection with a result's batch, and True if that is archived.

        For an unknown result the connection is the database's.
        """
        with self.reading_record() as connection:
            opened = self.archive.batch(connection, id)
            if opened is None:
                yield connection, False
                return
        with opened.reading() as connection:
            yield connection, True

    def require_writing(self) -> None:
        """Take the lock of a SQLite file for writing; raises `BadConfiguration` if that fails."""
        if self.file_lock is not None:
            self.file_lock.take()

    def close(self) -> None:
        """Write the queued jobs, then close the database."""
        if self._heard is not None:
            self._heard.close()
        self.writer.close()
        # Close the writer last: the last connection to close checkpoints the log.
        super().close()
        self._writing.dispose()
        if self.file_lock is not None:
            self.file_lock.release()
