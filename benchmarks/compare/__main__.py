"""The same inputs through two versions of the service; every difference of their answers.

    python -m benchmarks.compare --base main
    python -m benchmarks.compare --base 1a2b3c4 --inputs 200 --seed 7
    make compare BASE=main

Checks BASE out under .compare/ (kept, so that its kernels are compiled once),
serves both versions on this machine, each over an SQLite database of its own,
sends both the same requests, drawn with the seed, and then reads everything that
was recorded.  No answers are committed: another processor gives other last digits.

Not compared: ids (a reference to another record is), timings_us,
provenance.version, times of the service's own clock, cursors; of problems
everything but status, type and fields; of warnings what follows the code; of
metrics the values, counters of answers excepted; of the console's pages
everything but their status; of means the digits after the tenth.  Where requests
overlap, it is not compared whether a zone came from the cache.

openapi.yaml of both is compared without descriptions, summaries, titles and
examples.

The exit code is 1 where anything differs.  Each request with a difference is
kept in a file under .compare/reports/, with both answers.
"""

import argparse
import base64
import json
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import yaml
from tqdm import tqdm

from benchmarks.compare.answers import (
    Difference,
    Names,
    Plain,
    Received,
    differences,
)
from benchmarks.compare.inputs import Phase, Request, phases_of, write_twin
from benchmarks.compare.interface import interface_differences
from benchmarks.compare.servers import (
    HERE,
    KEPT,
    checked_out,
    commit_of,
    compile_kernels,
    served,
)

DEFAULT_INPUTS = 2000
DEFAULT_SEED = 19941026
MOST_SHOWN = 5
"""Greatest number of differences shown of one request."""
MOST_REQUESTS_SHOWN = 5
"""Greatest number of requests shown of one kind; files hold the others."""
POLL_S = 0.1
NO_ANSWER = 0
"""Status of a request that a server did not answer; it always counts as a difference."""
REPLAY_S = 300.0
_REFERENCE = re.compile(r"\{([\w-]+):([\w.]+)\}")
UNKNOWN_ID = "01JD0000000000000000000000"


class Server:
    """Server of one version; keeps the answers to which later requests refer."""

    def __init__(self, client: httpx.Client) -> None:
        self._client = client
        self._plain = Plain(Names())
        self._answers: dict[str, Any] = {}

    def ask(self, request: Request) -> tuple[Received, str]:
        """Send a request; returns the answer and the requested address."""
        path = _REFERENCE.sub(self._referred, request.path)
        deadline = time.monotonic() + REPLAY_S
        while True:
            try:
                answer = self._client.request(
                    request.method, path, content=request.content, headers=dict(request.headers)
                )
            except httpx.TransportError as error:
                return Received(NO_ANSWER, {}, repr(error).encode()), path
            received = Received(answer.status_code, answer.headers, answer.content)
            if not request.until_ended or not _runs(received) or time.monotonic() > deadline:
                break
            time.sleep(POLL_S)
        if answer.headers.get("content-type", "").startswith("application/json"):
            self._answers[request.name] = json.loads(answer.content)
        return received, path

    def plain(self, received: Received, request: Request, cached_counts: bool) -> Any:
        return self._plain.answer(received, request.name, cached_counts)

    def _referred(self, found: re.Match[str]) -> str:
        """Value in an earlier answer; an unknown id if that answer has no such value."""
        value: Any = self._answers.get(found[1])
        for part in found[2].split("."):
            try:
                value = value[int(part)] if isinstance(value, list) else value[part]
            except (KeyError, IndexError, TypeError, ValueError):
                return UNKNOWN_ID
        return str(value)


def _runs(received: Received) -> bool:
    return received.status == 200 and json.loads(received.body).get("state") == "running"


@dataclass
class Outcome:
    """Outcome of one request: statuses, and differences of the answers."""

    request: Request
    paths: tuple[str, str]
    received: tuple[Received, Received]
    found: list[Difference]


@dataclass
class Tally:
    """Results of all comparisons."""

    folder: Path
    allow_additions: bool
    counts: Counter[str] = field(default_factory=Counter)
    statuses: dict[str, Counter[int]] = field(default_factory=dict)
    differ: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: Outcome) -> None:
        kind = outcome.request.kind
        self.counts[kind] += 1
        self.statuses.setdefault(kind, Counter())[outcome.received[0].status] += 1
        found = [each for each in outcome.found if not (self.allow_additions and each.is_addition)]
        if any(each.status == NO_ANSWER for each in outcome.received):
            found = found or [
                Difference("status", *(each.body.decode() for each in outcome.received))
            ]
        if not found:
            return
        self.differ[kind] += 1
        file = self._keep(outcome, found)
        if self.differ[kind] <= MOST_REQUESTS_SHOWN:
            tqdm.write(f"\n{kind}: {outcome.request.name}  ({file})")
            for line in _lines(found):
                tqdm.write(line)

    def _keep(self, outcome: Outcome, found: Sequence[Difference]) -> Path:
        """Write a file with all data needed to repeat a request."""
        request = outcome.request
        file = self.folder / f"{request.name}.json"
        sent: dict[str, Any] = {
            "kind": request.kind,
            "method": request.method,
            "paths": dict(zip(("base", "here"), outcome.paths, strict=True)),
            "headers": dict(request.headers),
        }
        try:
            sent["content"] = request.content.decode()
        except UnicodeDecodeError:
            sent["content_base64"] = base64.b64encode(request.content).decode()
        sent["differences"] = [
            {"path": each.path, "base": each.base, "here": each.here} for each in found
        ]
        sent["answers"] = {
            name: received.body.decode(errors="replace")
            for name, received in zip(("base", "here"), outcome.received, strict=True)
        }
        file.write_text(json.dumps(sent, indent=1, ensure_ascii=False), encoding="utf-8")
        return file.relative_to(HERE) if file.is_relative_to(HERE) else file

    def table(self) -> str:
        """Table of results with a line for each kind of request."""
        width = max(len(kind) for kind in self.counts)
        lines = [f"{'kind':{width}}  requests  different  statuses"]
        for kind, count in self.counts.items():
            statuses = ", ".join(
                f"{status}: {number}" for status, number in sorted(self.statuses[kind].items())
            )
            lines.append(f"{kind:{width}}  {count:8}  {self.differ[kind]:9}  {statuses}")
        total, differ = self.counts.total(), self.differ.total()
        return "\n".join([*lines, f"{'all':{width}}  {total:8}  {differ:9}"])


def _lines(found: Sequence[Difference]) -> list[str]:
    lines = [
        f"  {each.path}: base {_short(each.base)}, here {_short(each.here)}"
        for each in found[:MOST_SHOWN]
    ]
    more = len(found) - len(lines)
    return [*lines, *([f"  and {more} more"] if more else [])]


def _short(value: Any, most: int = 120) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= most else f"{text[:most]}..."


def compare_phase(phase: Phase, servers: Sequence[Server], add: Callable[[Outcome], None]) -> None:
    """Send every request of a phase to both servers at the same time."""
    cached_counts = phase.at_once == 1

    def ask(server: Server, step: Callable[[], object]) -> list[tuple[Received, str]]:
        def one(request: Request) -> tuple[Received, str]:
            answer = server.ask(request)
            step()
            return answer

        # Answers come back in the order of the requests, whichever was first.
        with ThreadPoolExecutor(phase.at_once) as pool:
            return list(pool.map(one, phase.requests))

    with (
        tqdm(total=2 * len(phase.requests), desc=phase.title, unit="request", disable=None) as bar,
        ThreadPoolExecutor(len(servers)) as pool,
    ):
        base, here = pool.map(lambda server: ask(server, bar.update), servers)
    if not sys.stderr.isatty():
        print(f"{phase.title}: {len(phase.requests)} requests", flush=True)
    for request, one, other in zip(phase.requests, base, here, strict=True):
        plain = [
            server.plain(received, request, cached_counts)
            for server, (received, _) in zip(servers, (one, other), strict=True)
        ]
        add(Outcome(request, (one[1], other[1]), (one[0], other[0]), list(differences(*plain))))


def compare_interfaces(base: Path, allow_additions: bool) -> bool:
    """Print the differences of `openapi.yaml`; true if all are permitted."""
    documents = [
        yaml.load((tree / "openapi.yaml").read_text(encoding="utf-8"), Loader=yaml.CSafeLoader)
        for tree in (base, HERE)
    ]
    found = interface_differences(*documents)
    added = [each for each in found if each.is_addition]
    changed = [each for each in found if not each.is_addition]
    for title, some in (("additions", added), ("changes and removals", changed)):
        print(f"openapi.yaml: {len(some)} {title}")
        for each in some:
            print(f"  {each.path}: base {_short(each.base)}, here {_short(each.here)}")
    return not changed and (allow_additions or not added)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.compare",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--base", required=True, metavar="COMMIT", help="what this tree is held to")
    parser.add_argument(
        "--inputs",
        type=int,
        default=DEFAULT_INPUTS,
        help="about how many requests that compute (default: %(default)s); reading comes on top",
    )
    parser.add_argument(
        "--seed", type=int, default=DEFAULT_SEED, help="of every draw (default: %(default)s)"
    )
    parser.add_argument(
        "--allow-additions",
        action="store_true",
        help="fields, routes and components that the base does not have are no difference",
    )
    parsed = parser.parse_args(arguments)
    commit = commit_of(parsed.base)
    base = checked_out(commit)
    same = compare_interfaces(base, parsed.allow_additions)
    print("compiling the kernels of both (minutes the first time, else seconds)", flush=True)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(compile_kernels, (base, HERE)))
    reports = KEPT / "reports" / commit[:12]
    shutil.rmtree(reports, ignore_errors=True)
    reports.mkdir(parents=True)
    tally = Tally(reports, parsed.allow_additions)
    with ExitStack() as held:
        folder = Path(held.enter_context(tempfile.TemporaryDirectory()))
        missions, *databases = (folder / name for name in ("missions", "base", "here"))
        for each in (missions, *databases):
            each.mkdir()
        write_twin(missions, base)
        print(f"drawing the inputs with seed {parsed.seed}", flush=True)
        phases = phases_of(parsed.inputs, parsed.seed, missions)
        servers = [
            Server(held.enter_context(served(tree, database, missions)))
            for tree, database in zip((base, HERE), databases, strict=True)
        ]
        for phase in phases:
            compare_phase(phase, servers, tally.add)
    print()
    print(tally.table())
    if tally.differ:
        print(f"\nrequests with differences are kept in {reports.relative_to(HERE)}/")
    return 0 if same and not tally.differ else 1


if __name__ == "__main__":
    sys.exit(main())
