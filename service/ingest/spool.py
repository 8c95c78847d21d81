"""Telemetry files on disk until their replays are over, so that a restart goes on with them."""

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
"""An upload without a lock is left over after this: until then it may be about to be locked."""


@dataclass(frozen=True)
class SpooledReplay:
    """The settings that a replay needs beside its row and its file to go on."""

    id: str
    coding: Coding
    longest_bytes: int
    owner: str | None
    """The id of the token that it was started with."""
    caller: str
    """The name of that token."""
    spacecraft: list[str] | None
    """The spacecraft that the token is bound to; None: all."""
    packets: str | None = None
    """The spacecraft whose space packets the file holds; None: the file has lines."""
    is_csv: bool = False
    """True if the lines are CSV rows, as earlier versions wrote it in place of `form`."""
    form: str = ""
    """The name of the file's format."""

    @property
    def form_name(self) -> str:
        """The name of the file's format, of earlier versions too."""
        earlier = "packets" if self.packets is not None else CSV if self.is_csv else NDJSON
        return self.form or earlier


class Spool:
    """A folder of telemetry files, each with what its replay needs beside it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held: dict[str, IO[str]] = {}
        """The files beside the lines, locked while this process is at work on the replay."""

    def new_file(self) -> IO[bytes]:
        """A file for an upload; raises `Busy` where none can be made."""
        try:
            self._folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
            self._remove_left_over()
            return _locked(tempfile.NamedTemporaryFile(dir=self._folder, suffix=PART, delete=False))
        except OSError as error:
            raise Busy(f"uploads cannot be stored now: {error.strerror}", RETRY_S) from None

    def keep(self, file: IO[bytes], about: SpooledReplay) -> None:
        """Let an upload outlast this process; raises `Busy` where the disk fails."""
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
        """Remove the file of a replay that is over."""
        self.release(id)
        for suffix in (LINES, ABOUT):
            with suppress(OSError):
                (self._folder / id).with_suffix(suffix).unlink()

    def release(self, id: str) -> None:
        """Let another process go on with a replay."""
        held = self._held.pop(id, None)
        if held is not None:
            held.close()

    def path(self, id: str) -> Path:
        """The place of the file of a replay."""
        return (self._folder / id).with_suffix(LINES)

    def open(self, id: str) -> IO[bytes]:
        """The file of a replay; raises `OSError` where it is gone."""
        return self.path(id).open("rb")

    def ids(self) -> set[str]:
        """The replays whose files are there."""
        return {place.stem for place in self._folder.glob(f"*{LINES}")}

    def left(self) -> Iterator[SpooledReplay]:
        """The replays that no process is at work on, the oldest first; they are this one's now.

        Uploads that were broken off are removed.
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
        """Remove uploads that no process is receiving any more."""
        for place in self._folder.glob(f"*{PART}"):
            with suppress(OSError), place.open("rb") as file:
                if place.stat().st_mtime < time.time() - UNLOCKED_S:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    place.unlink()


def _private(path: Path) -> IO[str]:
    """A new text file that its owner alone can read, open for writing."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    return os.fdopen(os.open(path, flags, PRIVATE_FILE), "w", encoding="utf-8")


def _locked(file: IO[bytes]) -> IO[bytes]:
    """The file with a lock that ends with the process, however that ends."""
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return file
