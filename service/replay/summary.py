"""Summary of a replay: results to a file, progress to the terminal, a table at the end."""

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import msgspec
from acquire_client.models import Replay
from tqdm import tqdm

from service.errors import BadFile, Fault
from service.observations.input_formats import input_format, telemetry_format
from service.replay.items import LineOutcome

MAX_PROBLEMS_SHOWN = 20
STARS = ("observed", "unique", "ambiguous", "unmatched")


class ReplaySummary:
    """Summary of a replay's outcomes, taken in order; a context manager that closes the results.

    `results` receives one line for each batch: the answer exactly as sent, or `{"line", "problem"}`
    for a refused one.  `progress` None shows the bar on a terminal only.
    """

    def __init__(
        self,
        files: Sequence[Path],
        results: Path | None = None,
        progress: bool | None = None,
        title: str | None = None,
    ) -> None:
        self.new = self.replayed = self.refused = self.attitudes = 0
        self.gyro_new = self.gyro_replayed = 0
        self.stars: Counter[str] = Counter()
        self.seconds = 0.0
        self.packets: dict[str, Any] | None = None
        """Counts of space packets, as the service reports them; None for other files."""
        self._path = results
        self._results: IO[bytes] | None = None
        if results is not None:
            _require_place(results)
        self._bar = tqdm(
            total=_lines_in(files),
            desc=title,
            unit=" batches",
            file=sys.stderr,
            disable=None if progress is None else not progress,
            leave=False,
        )
        self._start = time.perf_counter()

    @property
    def batches(self) -> int:
        """Number of processed lines, apart from accepted gyro blocks."""
        return self.new + self.replayed + self.refused

    def add(self, outcome: LineOutcome) -> None:
        """Count the outcome of one line and write it to the results."""
        if outcome.answer is None:
            self.refused += 1
            self._print_problem(outcome)
            line = json.dumps(self._refusal(outcome)).encode()
        elif outcome.item.gyro is not None:
            self.gyro_replayed += outcome.replayed
            self.gyro_new += not outcome.replayed
            line = outcome.answer
        else:
            self.replayed += outcome.replayed
            self.new += not outcome.replayed
            self._count(msgspec.json.decode(outcome.answer))
            line = outcome.answer
        self._write(line + b"\n")
        self._bar.update()

    def follow(self, state: Replay) -> None:
        """Take over the counts of a replay that the service processes."""
        counts, lines = state.counts, state.lines
        self.new, self.replayed = counts.new, counts.repeated
        self.attitudes = counts.attitudes
        self.gyro_new, self.gyro_replayed = counts.gyro_new, counts.gyro_repeated
        self.packets = None if state.packets is None else msgspec.to_builtins(state.packets)
        self.stars = Counter({each: getattr(counts, each) for each in STARS})
        self._bar.update(lines.done - self._bar.n)
        if state.state not in ("running", "waiting"):
            # Refused lines with a known place are reported one by one.
            self.refused += lines.refused - len(state.errors)

    def _write(self, text: bytes) -> None:
        if self._path is None:
            return
        if self._results is None:
            # An older file is overwritten only once there is something to write.
            self._results = _opened(self._path)
        self._results.write(text)

    def _count(self, answer: dict[str, Any]) -> None:
        self.stars.update(answer["counts"])
        self.attitudes += answer["attitude"] is not None

    def _refusal(self, outcome: LineOutcome) -> dict[str, Any]:
        return {"line": outcome.item.number, "problem": outcome.problem}

    def _print_problem(self, outcome: LineOutcome) -> None:
        if self.refused > MAX_PROBLEMS_SHOWN:
            return
        where = f"{outcome.item.file}:{outcome.item.number}"
        detail = (outcome.problem or {}).get("detail", "refused")
        tqdm.write(f"{where}: {detail}", file=sys.stderr)
        if self.refused == MAX_PROBLEMS_SHOWN:
            tqdm.write("further refused lines are counted, not shown", file=sys.stderr)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.seconds = time.perf_counter() - self._start
        self._bar.close()
        if error is None:
            self._write(b"")
        if self._results is not None:
            self._results.close()

    def counts(self) -> dict[str, Any]:
        """Summary of the replay as plain values, for JSON."""
        return {
            "batches": self.batches,
            "new": self.new,
            "already_recorded": self.replayed,
            "refused": self.refused,
            "stars": {word: self.stars[word] for word in STARS},
            "attitudes": self.attitudes,
            "batches_per_s": self.batches / max(self.seconds, 1e-9),
            **({} if self.packets is None else {"packets": self.packets}),
            **self._gyro_counts(),
        }

    def _gyro_counts(self) -> dict[str, Any]:
        """Counts of gyro blocks by outcome; empty if no gyro block was recorded or repeated."""
        if not (self.gyro_new or self.gyro_replayed):
            return {}
        return {"gyro_blocks": {"new": self.gyro_new, "already_recorded": self.gyro_replayed}}

    def table(self) -> str:
        """Summary of the replay as a table for people: batches, stars, attitudes and speed."""
        observed = self.stars["observed"]
        rows = [("batches", str(self.batches))]
        rows += [("  new", str(self.new)), ("  already recorded", str(self.replayed))]
        rows += [("  refused", str(self.refused)), ("stars", str(observed))]
        rows += [
            (f"  {word}", f"{self.stars[word]}{_share(self.stars[word], observed)}")
            for word in ("unique", "ambiguous", "unmatched")
        ]
        rows += [("attitudes", str(self.attitudes))]
        if self._gyro_counts():
            rows += [("gyro blocks", str(self.gyro_new + self.gyro_replayed))]
            rows += [("  new", str(self.gyro_new))]
            rows += [("  already recorded", str(self.gyro_replayed))]
        rows += _packet_rows(self.packets)
        rows += [("speed", f"{self.batches / max(self.seconds, 1e-9):.0f} batches/s")]
        return "\n".join(f"{name:<20}{value}" for name, value in rows)


def _packet_rows(packets: dict[str, Any] | None) -> list[tuple[str, str]]:
    if packets is None:
        return []
    words = {
        "unknown": "unknown",
        "not_asked": "other APIDs",
        "idle": "idle",
        "without_stars": "without stars",
        "joined": "joined segments",
        "incomplete": "lack segments",
        "refused": "unreadable",
        "without_attitude": "no a priori",
    }
    rows = [("packets", str(packets["packets"]))]
    rows += [(f"  {name}", str(packets[word])) for word, name in words.items()]
    gaps = f"{packets['gaps']}  ({packets['missing']} packets missing)"
    rows += [("  sequence gaps", gaps), ("  steps backward", str(packets["backward"]))]
    # For a damaged file these counts matter most.
    rows += [("  bytes not read", str(packets["unread_bytes"]))] if packets["unread_bytes"] else []
    rows += [("  empty files", str(packets["empty_files"]))] if packets["empty_files"] else []
    if packets["gyro_blocks"]:
        blocks = f"{packets['gyro_blocks']}  ({packets['gyro_samples']} samples)"
        rows += [("  gyro blocks", blocks)]
    unknown = [str(each["apid"]) for each in packets["apids"] if not each["described"]]
    if unknown:
        rows += [("  unknown APIDs", ", ".join(unknown[:20]))]
    return rows


def _share(part: int, whole: int) -> str:
    return f"  ({100.0 * part / whole:.2f} %)" if whole else ""


def _require_place(path: Path) -> None:
    """Raise `BadFile` for a path that cannot be written, without touching an existing file."""
    folder = path.absolute().parent
    place = path if path.exists() else folder
    if path.is_dir() or not folder.is_dir() or not os.access(place, os.W_OK):
        why = "is a folder" if path.is_dir() else "the folder is missing or closed to writing"
        raise BadFile(Fault(str(path), f"cannot be written: {why}"))


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("wb")
    except OSError as error:
        raise BadFile(Fault(str(path), f"cannot be written: {error.strerror}")) from None


def _lines_in(files: Sequence[Path]) -> int | None:
    """Number of lines in the files, for the progress bar; None if not batches, or unreadable."""
    count = 0
    for file in files:
        if not input_format(telemetry_format(file)).one_a_line:
            return None
        try:
            with file.open("rb") as stream:
                while piece := stream.read(1 << 20):
                    count += piece.count(b"\n")
        except OSError:
            return None
    return count
