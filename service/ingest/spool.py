"""Spool of telemetry files on disk until their replays end, so that a restart can resume them."""

import fcntl
import json
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from service.errors import Busy
from service.observations.decompress import Coding
from service.observations.input_formats import CSV, NDJSON
from service.storage.sql.database_file import PRIVATE_FILE, PRIVATE_FOLDER

PART, LINES, ABOUT = ".part", ".lines", ".json"
RETRY_S = 30
UNLOCKED_S = 60.0
"""Seconds after which an unlocked upload counts as abandoned; earlier its lock may still come."""


@dataclass(frozen=True)
class SpooledReplay:
    """Settings that a replay needs in addition to its row and its file, to be resumed."""

    id: str
    coding: Coding
    longest_bytes: int
    owner: str | None
    """Id of the token that started the replay; None without tokens."""
    caller: str
    """Name of the token that started the replay."""
    spacecraft: list[str] | None
    """Spacecraft that the token is limited to; None: all."""
    packets: str | None = None
    """Spacecraft whose space packets the file holds; None for a file of lines."""
    is_csv: bool = False
    """True for a file of CSV rows, as written by versions without `form`."""
    form: str = ""
    """Name of the file's format; empty if an earlier version wrote the settings."""

    @property
    def form_name(self) -> str:
        """Name of the file's format, also for settings of earlier versions."""
        earlier = "packets" if self.packets is not None else CSV if self.is_csv else NDJSON
        return self.form or earlier


class Spool:
    """Folder of telemetry files for replays, each with a file of settings beside it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held: dict[str, IO[str]] = {}
        """Open settings files by replay id, locked while this process works on the replay."""

    def new_file(self) -> IO[bytes]:
        """Create a file for an upload; raises `Busy` if that fails."""
        try:
            self._folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
            self._remove_left_over()
            return _locked(tempfile.NamedTemporaryFile(dir=self._folder, suffix=PART, delete=False))
        except OSError as error:
            raise Busy(f"uploads cannot be stored now: {error.strerror}", RETRY_S) from None

    def keep(self, file: IO[bytes], about: SpooledReplay) -> None:
        """Keep an upload and its settings beyond this process; raises `Busy` if the disk fails."""
        try:
            file.flush()
            os.fsync(file.fileno())
            place = self._folder / about.id
            beside = self._held[about.id] = _private(place.with_suffix(ABOUT))
            fcntl.flock(beside, fcntl.LOCK_EX | fcntl.LOCK_NB)
            json.dump(asdict(about), beside)
            beside.flush()
            os.fsync(beside.fileno())
            os.replace(file.name, place.with_suffix(LINES))
            folder = os.open(self._folder, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            self.drop(about.id)
            raise Busy(f"uploads cannot be stored now: {error.strerror}", RETRY_S) from None

    def drop(self, id: str) -> None:
        """Delete the files of a finished replay."""
        self.release(id)
        for suffix in (LINES, ABOUT):
            with suppress(OSError):
                (self._folder / id).with_suffix(suffix).unlink()

    def release(self, id: str) -> None:
        """Unlock a replay, so that another process can resume it."""
        held = self._held.pop(id, None)
        if held is not None:
            held.close()

    def path(self, id: str) -> Path:
        """Path of a replay's telemetry file."""
        return (self._folder / id).with_suffix(LINES)

    def open(self, id: str) -> IO[bytes]:
        """Open a replay's telemetry file; raises `OSError` if it is missing."""
        return self.path(id).open("rb")

    def ids(self) -> set[str]:
        """Ids of the replays whose telemetry files exist."""
        return {place.stem for place in self._folder.glob(f"*{LINES}")}

    def left(self) -> Iterator[SpooledReplay]:
        """Take over the replays that no process works on, the oldest first.

        Incomplete uploads are deleted.
        """
        if not self._folder.is_dir():
            return
        for place in sorted(self._folder.glob(f"*{ABOUT}")):
            beside = place.open(encoding="utf-8")
            try:
                fcntl.flock(beside, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                beside.close()
                continue
            self._held[place.stem] = beside
            if place.with_suffix(LINES).exists():
                yield SpooledReplay(**json.load(beside))
            else:
                self.drop(place.stem)
        self._remove_left_over()

    def _remove_left_over(self) -> None:
        """Delete incomplete uploads that no process is receiving any more."""
        for place in self._folder.glob(f"*{PART}"):
            with suppress(OSError), place.open("rb") as file:
                if place.stat().st_mtime < time.time() - UNLOCKED_S:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    place.unlink()


def _private(path: Path) -> IO[str]:
    """Create a text file that only its owner can read, open for writing."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    return os.fdopen(os.open(path, flags, PRIVATE_FILE), "w", encoding="utf-8")


def _locked(file: IO[bytes]) -> IO[bytes]:
    """Lock a file until it is closed or the process ends."""
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return file
