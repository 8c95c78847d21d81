"""Progress files of reprocessings into an archive, one for each run, beside the parts.

    reprocessing/RUN.json

The command writes the file, the service shows it; pyarrow is not needed.
"""

import logging
import os
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import msgspec
from msgspec import Struct

from service.times import Utc, recorded_utc, utc_now

FOLDER = "reprocessing"
SILENT_S = 60.0
"""Seconds without an update after which a command counts as interrupted."""

log = logging.getLogger(__name__)


class Reprocessing(Struct, frozen=True, kw_only=True):
    """Progress of one reprocessing into an archive, as last written."""

    run: str
    source: str
    partitions: int
    partitions_done: int
    batches: int
    """Number of batches in the period of the reprocessing."""
    before: int
    """Number of the period's batches that the run had before the command began."""
    recorded: int
    refused: int
    started: str
    updated: str
    finished: str | None

    @property
    def batches_per_s(self) -> float:
        """Mean rate in batches per second since the command began."""
        passed_s = _seconds(self.started, self.finished or self.updated)
        return (self.recorded + self.refused) / passed_s if passed_s > 0.0 else 0.0

    @property
    def left_s(self) -> float | None:
        """Estimated seconds until the reprocessing ends, at its mean rate; None if not known."""
        left = self.batches - self.before - self.recorded - self.refused
        if self.finished is not None or left <= 0:
            return 0.0
        return left / self.batches_per_s if self.batches_per_s > 0.0 else None

    def state(self, now: Utc) -> Literal["running", "done", "interrupted"]:
        """State of a reprocessing at a time: running, done, or interrupted if long silent."""
        if self.finished is not None:
            return "done"
        silent_s = (now.tai_ns - recorded_utc(self.updated).tai_ns) * 1e-9
        return "running" if silent_s < SILENT_S else "interrupted"


def write_reprocessing(folder: Path, state: Reprocessing) -> None:
    """Write the progress file of a reprocessing, replacing the previous one."""
    place = folder / FOLDER
    place.mkdir(exist_ok=True)
    file = place / f"{quote(state.run, safe='')}.json"
    beside = file.with_suffix(".new")
    beside.write_bytes(msgspec.json.format(msgspec.json.encode(state), indent=1))
    # The file may be lost in a power cut: nothing depends on it.
    os.replace(beside, file)


def reprocessings(folder: Path) -> list[Reprocessing]:
    """All reprocessings into an archive, the latest first; unreadable files are left out."""
    found = []
    for file in (folder / FOLDER).glob("*.json"):
        try:
            found.append(msgspec.json.decode(file.read_bytes(), type=Reprocessing))
        except (OSError, msgspec.MsgspecError) as error:
            log.warning("%s: cannot be read: %s", file, error)
    return sorted(found, key=lambda each: each.started, reverse=True)


def now_text() -> str:
    """The current UTC time, as text for the state of a reprocessing."""
    return utc_now().text


def _seconds(start: str, end: str) -> float:
    return (recorded_utc(end).tai_ns - recorded_utc(start).tai_ns) * 1e-9
