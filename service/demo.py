"""The whole service at work: a real server, sample passes through HTTP, a table against truth.

Everything goes into one folder.  A second time the samples are the same, the
server knows their batches already, and the table is the same.
"""

import dataclasses
import hashlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx

from service.errors import BadConfiguration, BadInput, Busy, Fault
from service.missions.mission import load_missions
from service.replay.items import items_of
from service.replay.over_http import replay_over_http
from service.replay.tally import Tally
from service.settings import PREFIX, Settings
from service.simulate.files import read_objects, truth_path, write_pass
from service.simulate.score import Score, score, together
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.sky.catalog import load_embedded
from service.sky.shelf import Shelf
from service.sky.view import Sky

MISSIONS = ("XTE", "SWAS", "SOHO")
START_S = 120.0
"""The longest that the server may take to be ready: the first time it compiles."""
STOP_S = 15.0
TOLD_TO_STOP = (0, 130, 143, -signal.SIGINT, -signal.SIGTERM)
CONCURRENCY = 2
"""Posts at a time: more would only wait for each other and swell the times that are shown."""


def run_demo(folder: Path, settings: Settings, batches: int, seed: int, once: bool) -> int:
    """Serve, replay and print; then keep serving until interrupted, unless `once`.

    Raises `BadInput` for a pass that cannot be, `BadConfiguration` where the
    port is taken or the server does not start.
    """
    started = time.perf_counter()
    wanted = Pass(batches, seed)
    if settings.port == 0:
        raise BadInput(Fault("--port", "must be a port that can be named", "0"))
    folder.mkdir(parents=True, exist_ok=True)
    # Whatever lies in here can be made again: it is none of a repository's business.
    (folder / ".gitignore").write_text("*\n", encoding="utf-8")
    database = folder / "acquire.db"
    settings = dataclasses.replace(settings, database=f"sqlite:///{database}")
    url = _url(settings)
    _require_free(settings)
    with _served(settings, folder / "server.log") as server:
        files = _samples(folder, wanted)
        _wait_until_ready(server, url, folder / "server.log")
        run = f"demo-{_digest(files)}"
        scores = {}
        for name, file in zip(MISSIONS, files, strict=True):
            results = file.with_name(f"{file.stem}.results.ndjson")
            with Tally([file], results, title=f"{name:<4}") as tally:
                replay_over_http(url, items_of([file], run), tally.add, concurrency=CONCURRENCY)
            scores[name] = score(read_objects(results), read_objects(truth_path(file)))
        print(table(scores))
        print()
        print(f"That took {time.perf_counter() - started:.1f} s. Where to look next:")
        for place, what in _where_next(url, run, folder, settings):
            print(f"  {place}\n      {what}")
        sys.stdout.flush()
        if once:
            return 0
        print(f"\nServing on {url} until Ctrl-C.", flush=True)
        with suppress(KeyboardInterrupt):
            # A terminal's Ctrl-C reaches the server as well, which may be the first to go.
            if server.wait() not in TOLD_TO_STOP:
                raise Busy(f"the server stopped by itself; see {folder / 'server.log'}")
        print("stopped")
        return 0


def table(scores: dict[str, dict[str, Score]]) -> str:
    """Per mission a line of the nominal stretches and one of the stretches with errors."""
    head = (
        f"{'':<15}{'batches':>8}{'stars':>7}{'unique':>9}{'ambig.':>8}{'unmatch.':>9}{'wrong':>8}"
        f"{'attitudes':>11}{'error':>8}{'sigma':>7}{'within':>8}{'solve':>8}{'whole':>8}"
    )
    units = (
        f"{'':<15}{'':>8}{'':>7}{'%':>9}{'%':>8}{'%':>9}{'%':>8}"
        f"{'':>11}{'arcsec':>8}{'arcsec':>7}{'%':>8}{'µs':>8}{'µs':>8}"
    )
    lines = [head, units]
    for name, stretches in scores.items():
        lines.append(_row(f"{name} nominal", stretches.get("nominal", Score())))
        serious = [each for kind, each in stretches.items() if kind != "nominal"]
        lines.append(_row(f"{name} serious", together(serious)))
    notes = (
        "nominal: the a priori error that the mission allows for; serious: a growing attitude",
        "error and spurious stars.  wrong: named with certainty, but another star than the true",
        "one.  error, sigma: one sigma along the attitude's worst axis, as it was and as the",
        "covariance predicts it.  within: attitudes inside their own 99.7 % region.  solve:",
        "identification and solution; whole: zone and recording too; medians of a batch.",
    )
    return "\n".join([*lines, "", *notes])


def _row(title: str, of: Score) -> str:
    return (
        f"{title:<15}{of.batches:>8}{of.stars['observed']:>7}{of.percent('unique'):>9.2f}"
        f"{of.percent('ambiguous'):>8.2f}{of.percent('unmatched'):>9.2f}{of.percent('wrong'):>8.2f}"
        f"{of.attitudes:>11}{of.seen_sigma_arcsec:>8.2f}{of.predicted_sigma_arcsec:>7.2f}"
        f"{of.within_percent:>8.2f}{of.median_solving_us:>8.0f}{of.median_whole_us:>8.0f}"
    )


def _where_next(url: str, run: str, folder: Path, settings: Settings) -> Iterator[tuple[str, str]]:
    yield f"{url}/?run={run}", "the page of this run: ambiguous and unmatched stars over time"
    yield (
        f"curl -s '{url}/api/v1/batches?spacecraft=XTE&run={run}&limit=1'",
        "the latest batch of XTE as the API gives it",
    )
    yield f"{folder}/*.results.ndjson", "every answer; the truth is in *.truth.ndjson beside it"
    yield "docs/quickstart.md", "a walk: post a batch, read the attitude, try other tolerances"
    yield (
        f"acquire serve --database {settings.database}",
        "serve these records again, without the demonstration",
    )


def _samples(folder: Path, wanted: Pass) -> list[Path]:
    # As the server: a site's own missions and catalog stay out of the demonstration.
    sky, missions = Sky(load_embedded(), Shelf(64 << 20)), load_missions()
    files = [folder / f"{name.lower()}.ndjson" for name in MISSIONS]
    for name, file in zip(MISSIONS, files, strict=True):
        write_pass(draw_pass(missions[name], sky, wanted), file)
    return files


def _digest(files: Sequence[Path]) -> str:
    # The run is named after what is in it: other samples can never clash with recorded ones.
    content = hashlib.sha256()
    for file in files:
        content.update(file.read_bytes())
    return content.hexdigest()[:8]


def _url(settings: Settings) -> str:
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    return f"http://{host}:{settings.port}"


def _require_free(settings: Settings) -> None:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        # As the server does: a port that was just let go of is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            raise BadConfiguration(
                f"{_url(settings)}: {error.strerror}; stop what serves there, or choose another "
                "port with --port (make run PORT=8100)"
            ) from None


@contextmanager
def _served(settings: Settings, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A server of its own process, stopped when the block ends, however it ends."""
    command = [sys.executable, "-m", "service.cli", "serve"]
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
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def _wait_until_ready(server: subprocess.Popen[bytes], url: str, log: Path) -> None:
    give_up = time.monotonic() + START_S
    with httpx.Client(base_url=url, timeout=START_S, trust_env=False) as client:
        while time.monotonic() < give_up:
            if server.poll() is not None:
                said = log.read_text(encoding="utf-8", errors="replace").strip()
                raise BadConfiguration(f"the server did not start:\n{said}")
            try:
                if client.get("/readyz").status_code == 200:
                    return
            except httpx.TransportError:
                pass
            time.sleep(0.1)
    raise Busy(f"the server at {url} is not ready after {START_S:.0f} s; see {log}")
