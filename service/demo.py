"""Demonstration: a real server, simulated passes sent through HTTP, and a table against truth.

All files are in one folder.  A second run draws the same samples, whose batches the server has
recorded already, and prints the same table.
"""

import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import httpx
import msgspec

from service.acquire.kernel_build import KernelBuild, kernel_progress
from service.child_processes import command_of
from service.errors import BadConfiguration, BadInput, Busy, Fault
from service.feature import features_on
from service.missions.mission import load_missions
from service.replay.items import items_of
from service.replay.over_http import GIVE_UP_AFTER_S, replay_over_http
from service.replay.summary import ReplaySummary
from service.resources import shipped
from service.settings import PREFIX, Settings, require_free, url_of
from service.simulate import telemetry
from service.simulate.score import Score, score, score_table, together
from service.simulate.stretches import Pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.times import HOUR_S

MISSIONS = ("XTE", "SWAS", "SOHO")
START = "1999-03-01T00:00:00.000Z"
"""Start of every simulated pass: a day on which all three spacecraft operated."""
WIDTH_S = 20 * HOUR_S
"""Duration of a simulated pass in seconds, within the day that the console shows first."""
GYRO = telemetry.GyroWanted(step_s=10.0)
"""Gyro data of a simulated pass: coarse in time, so that 20 hours are 7,200 samples."""
START_S = 300.0
"""Longest wait for the server after its kernels are compiled, in seconds."""
COMPILING_S = 1800.0
"""Longest wait for the compilation in seconds: it takes minutes, more on a busy machine."""
COMPILES_AFTER_S = 5.0
"""Seconds of waiting after which a message gives the reason."""
PROGRESS_EVERY_S = 10.0
"""Seconds between progress messages without a terminal."""
STOP_S = 15.0
STOPPED_EXIT_CODES = (0, 130, 143, -signal.SIGINT, -signal.SIGTERM)
CONCURRENCY = 2
"""Number of simultaneous posts: more would only wait and lengthen the times shown."""


def run_demo(
    folder: Path,
    settings: Settings,
    batches: int,
    seed: int,
    once: bool,
    as_json: bool = False,
) -> int:
    """Run the demonstration: serve, replay and print; then serve until interrupted, unless `once`.

    `as_json` prints the table's figures as JSON in place of the table.

    Raises `BadInput` for an impossible pass, `BadConfiguration` where the port is taken or the
    server does not start.
    """
    started = time.perf_counter()
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        # A script that starts this with & ignores SIGINT: without this only a kill would end it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    wanted = Pass(batches, seed, START, WIDTH_S / batches)
    if settings.port == 0:
        raise BadInput(Fault("--port", "must be a port that can be named", "0"))
    folder.mkdir(parents=True, exist_ok=True)
    unused = "" if settings.database == Settings.database else f"; {PREFIX}DATABASE is not used"
    print(f"samples, answers and database: {folder.resolve()}{unused}", file=sys.stderr, flush=True)
    # The folder's content can be made again: let git ignore it.
    (folder / ".gitignore").write_text("*\n", encoding="utf-8")
    database = folder / "acquire.db"
    settings = dataclasses.replace(settings, database=f"sqlite:///{database}")
    url = url_of(settings.host, settings.port)
    require_free(settings.host, settings.port)
    with _served(settings, folder / "server.log") as server:
        files = _samples(folder, wanted)
        _wait_until_ready(server, url, folder / "server.log")
        ready_s = time.perf_counter() - started
        run = f"demo-{_digest(files)}"
        scores = _scores(url, files, run, ready_s)
        whole_s = time.perf_counter() - started
        if as_json:
            seconds = {"seconds": whole_s, "seconds_until_ready": ready_s}
            _print_json({"run": run, "url": url, **seconds, "scores": rows_of(scores)})
        else:
            print(score_table(scores))
            print()
            print(f"That took {whole_s:.1f} s, {ready_s:.1f} s of them until the server was ready.")
            if KernelBuild().is_needed:
                print(f"Still {kernel_progress().line(whole_s)}; the next start goes on with it.")
            print("Where to look next:")
            for place, what in _where_next(url, run, folder, settings, once):
                print(f"  {place}\n      {what}")
        sys.stdout.flush()
        if once:
            return 0
        stream = sys.stderr if as_json else sys.stdout
        print(f"\nServing on {url} until Ctrl-C.", file=stream, flush=True)
        with suppress(KeyboardInterrupt):
            # A terminal's Ctrl-C also reaches the server, which may stop first.
            if server.wait() not in STOPPED_EXIT_CODES:
                raise Busy(f"the server stopped by itself; see {folder / 'server.log'}")
        print("stopped", file=stream)
        return 0


def rows_of(scores: Mapping[str, Mapping[str, Score]]) -> list[dict[str, Any]]:
    """Rows of the demonstration's table as plain values; a figure without batches is NaN."""
    rows = []
    for name, stretches in scores.items():
        serious = together(each for kind, each in stretches.items() if kind != "nominal")
        for kind, of in (("nominal", stretches.get("nominal", Score())), ("serious", serious)):
            rows.append(
                {
                    "spacecraft": name,
                    "kind": kind,
                    "batches": of.batches,
                    "refused": of.refused,
                    "stars": of.stars["observed"],
                    **{
                        f"{word}_percent": of.percent(word)
                        for word in ("unique", "ambiguous", "unmatched", "wrong")
                    },
                    "attitudes": of.attitudes,
                    "error_arcsec": of.seen_sigma_arcsec,
                    "sigma_arcsec": of.predicted_sigma_arcsec,
                    "within_percent": of.within_percent,
                    "solve_us": of.median_solving_us,
                    "whole_us": of.median_whole_us,
                }
            )
    return rows


def _print_json(value: Any) -> None:
    print(msgspec.json.format(msgspec.json.encode(value), indent=1).decode())


def _where_next(
    url: str, run: str, folder: Path, settings: Settings, once: bool
) -> Iterator[tuple[str, str]]:
    serve = f"acquire serve --database {settings.database}"
    for name in ("host", "port"):
        if getattr(settings, name) != getattr(Settings(), name):
            serve += f" --{name} {getattr(settings, name)}"
    page = f"{url}/?run={run}"
    if once:
        # The server has stopped: its address alone would be useless.
        yield serve, "serve these records; the console of this run is then"
        yield f"  {page}", "  every spacecraft, its trends, each batch down to its stars"
    else:
        yield (
            page,
            "the console of this run: every spacecraft, its trends, each batch down to its stars",
        )
        yield (
            f"curl -s '{url}/api/v1/batches?spacecraft=XTE&run={run}&limit=1'",
            "the latest batch of XTE as the API gives it",
        )
    yield f"{folder}/*.results.ndjson", "every answer; the truth is in *.truth.ndjson beside it"
    stopped = "" if once else "with this server stopped: "
    installed = {each.name for each in features_on(settings.features_off)}
    if "definitive" in installed:
        yield (
            f"acquire smooth XTE --run {run} --database {settings.database}",
            f"{stopped}filter and smooth XTE with its gyro; its page Definitive attitude draws it",
        )
    if "pictures" in installed:
        yield (
            "acquire frame PICTURE",
            "any picture of the sky, from any camera: attitude, lens, and names of its stars",
        )
    # An installed wheel has no documents.
    if shipped("docs", "quickstart.md").is_file():
        yield "docs/quickstart.md", "a walk: post a batch, read the attitude, try other tolerances"
    if not once:
        yield serve, "serve these records again, without the demonstration"


def _samples(folder: Path, wanted: Pass) -> list[Path]:
    # Like the server, without a site's own missions and catalog.
    sky, missions = SkyModel(load_embedded(), LruCache(64 << 20)), load_missions()
    files = [folder / f"{name.lower()}.ndjson" for name in MISSIONS]
    for name, file in zip(MISSIONS, files, strict=True):
        drawn = telemetry.draw_pass(missions[name], sky, wanted)
        telemetry.write_pass(
            telemetry.with_gyro(drawn, missions[name], GYRO, WIDTH_S, wanted.seed), file
        )
    return files


def _scores(url: str, files: Sequence[Path], run: str, ready_s: float) -> dict[str, Any]:
    """Send the passes to the server, which took `ready_s` seconds to start; scores by mission.

    The kernels of the whole sky may not be compiled by then: a batch that needs them waits.
    """
    give_up_after_s = GIVE_UP_AFTER_S
    if KernelBuild().is_needed:
        give_up_after_s = COMPILING_S
        print(
            f"ready for batches with an a priori attitude after {ready_s:.0f} s; compiled "
            "behind them: kernels of the whole sky, then of filter, tracks and pictures",
            file=sys.stderr,
            flush=True,
        )
    scores = {}
    for name, file in zip(MISSIONS, files, strict=True):
        results = file.with_name(f"{file.stem}.results.ndjson")
        with ReplaySummary([file], results, title=f"{name:<4}") as summary:
            replay_over_http(
                url,
                items_of([file], run),
                summary.add,
                concurrency=CONCURRENCY,
                give_up_after_s=give_up_after_s,
                watched_run=run,
            )
        scores[name] = score(_answers(results), telemetry.read_objects(telemetry.truth_path(file)))
    return scores


def _answers(results: Path) -> Iterator[dict[str, Any]]:
    """Answers to batches in a file of results, without those to gyro blocks."""
    return (each for each in telemetry.read_objects(results) if "block" not in each)


def _digest(files: Sequence[Path]) -> str:
    # The run is named after its content: other samples cannot conflict with recorded ones.
    content = hashlib.sha256()
    for file in files:
        content.update(file.read_bytes())
    return content.hexdigest()[:8]


@contextmanager
def _served(settings: Settings, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a server process for a `with` block; it is stopped at the block's end in any case."""
    command = [*command_of("service.cli"), "serve"]
    command += ["--host", settings.host, "--port", str(settings.port)]
    command += ["--database", settings.database]
    before = signal.signal(signal.SIGTERM, _interrupt)
    with log.open("wb") as output:
        server = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={name: text for name, text in os.environ.items() if not name.startswith(PREFIX)},
        )
    try:
        yield server
    finally:
        server.terminate()
        try:
            server.wait(STOP_S)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            # A second Ctrl-C ends the wait.
            server.kill()
            server.wait()
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def _wait_until_ready(server: subprocess.Popen[bytes], url: str, log: Path) -> None:
    start = compiled = time.monotonic()
    with httpx.Client(base_url=url, timeout=START_S, trust_env=False) as client, _Waiting() as wait:
        while (waited_s := time.monotonic() - start) < COMPILING_S:
            if KernelBuild().is_needed:
                compiled = time.monotonic()
            elif time.monotonic() - compiled > START_S:
                break
            if server.poll() is not None:
                output = log.read_text(encoding="utf-8", errors="replace").strip()
                raise BadConfiguration(f"the server did not start:\n{output}")
            try:
                if client.get("/readyz").status_code == 200:
                    return
            except httpx.TransportError:
                pass
            wait.show(waited_s)
            time.sleep(0.1)
    raise Busy(f"the server at {url} is not ready after {waited_s:.0f} s; see {log}")


class _Waiting:
    """Progress of the server's start: one changing line on a terminal, else a line at times."""

    def __init__(self) -> None:
        self._moves = sys.stderr.isatty()
        self._shown = 0
        self._next_s = COMPILES_AFTER_S

    def show(self, waited_s: float) -> None:
        """Show the time that the start of the server has taken."""
        line = f"the server is starting: {waited_s:.0f} s"
        if waited_s >= COMPILES_AFTER_S and self._compiles():
            line += f"; {kernel_progress().line(waited_s)} (only the first start compiles)"
        if self._moves:
            print(f"\r{line:<{self._shown}}", end="", file=sys.stderr, flush=True)
            self._shown = len(line)
        elif waited_s >= self._next_s:
            print(line, file=sys.stderr, flush=True)
            self._next_s += PROGRESS_EVERY_S

    @staticmethod
    def _compiles() -> bool:
        """True if the server, which shares this process's cache, is still compiling its kernels."""
        return KernelBuild().is_needed

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            print(f"\r{'':<{self._shown}}\r", end="", file=sys.stderr, flush=True)
