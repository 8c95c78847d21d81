"""`acquire frame` and `acquire simulate frames`: frames in, what was made of them out."""

import json
import math
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from service.errors import AcquisitionError, BadInput, Busy, Fault, NotAdmitted, shown_value
from service.missions.mission import Mission
from service.settings import Settings
from service.sky.catalog import Catalog

FRAME_TYPE = "application/octet-stream"
TEXTS = ("batch", "time", "run", "tracker", "aberration", "centroid")
TIMEOUT_S = 120.0


class Desk(Protocol):
    """Where frames are handed in: a service, or the operations of this process."""

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        """The answer's JSON; raises `BadInput` for what is refused."""

    def overlay(self, id: str) -> bytes:
        """The PNG of a result."""


class Refused(AcquisitionError):
    """What a service said of a frame that it did not take."""


def send_frames(parsed: Namespace, settings: Settings) -> int:
    """Send every file, print what became of it; 1 where one was refused."""
    if parsed.batch is not None and len(parsed.files) > 1:
        message = "names one frame; leave it out for several"
        raise BadInput(Fault("--batch", message, shown_value(parsed.batch)))
    if parsed.database is not None and not parsed.in_process:
        message = "goes with --in-process; a running service has its own"
        raise BadInput(Fault("--database", message, shown_value(parsed.database)))
    refused = 0
    with _desk(parsed, settings) as desk:
        for file in parsed.files:
            try:
                body = desk.submit(parsed.spacecraft, _known(parsed, file), file)
            except (BadInput, Refused) as error:
                refused += 1
                print(f"acquire: {file}: {error}", file=sys.stderr)
                continue
            answer = json.loads(body)
            print(body.decode() if parsed.json else _told(file, answer))
            if parsed.overlay is not None:
                _write_overlay(parsed, file, desk.overlay(answer["id"]))
    return 1 if refused else 0


def write_drawn(parsed: Namespace, mission: Mission, catalog: Catalog) -> int:
    """Draw frames into a folder, with a bar."""
    from tqdm import tqdm

    from service.simulate.frame_files import TRUTH, write_frames
    from service.simulate.frames import DEFAULT_START, FrameSettings, draw_frames
    from service.sky.shelf import Shelf
    from service.sky.view import Sky

    wanted = FrameSettings(
        frames=parsed.frames,
        seed=parsed.seed,
        tracker=parsed.tracker,
        start=parsed.start or DEFAULT_START,
        psf=parsed.psf,
        a_priori_error_deg=None if parsed.lost else parsed.prior_error,
        rates_deg_per_s=parsed.rates,
        response_sigma=parsed.response,
        sky_e_per_s=parsed.sky,
        hot_pixels=parsed.hot_pixels,
        cosmic_rays=parsed.cosmic_rays,
    )
    drawn = draw_frames(mission, Sky(catalog, Shelf(64 << 20)), wanted)
    bar = tqdm(drawn, total=wanted.frames, unit="frame", disable=None)
    count = write_frames(bar, parsed.output, parsed.format)
    print(f"{parsed.output}: {count} frames of {mission.name}; truth: {parsed.output / TRUTH}")
    return 0


def _known(parsed: Namespace, file: Path) -> dict[str, Any]:
    """What stands beside a frame, with the command's own options in its place."""
    known: dict[str, Any] = {}
    beside = file.with_suffix(".json")
    if beside.is_file():
        known = _object(beside.read_text(encoding="utf-8"), str(beside))
    if parsed.a_priori is not None:
        known["a_priori"] = _json(parsed.a_priori, "--a-priori")
    for name in ("tracker", "time", "batch", "run", "centroid"):
        if getattr(parsed, name) is not None:
            known[name] = getattr(parsed, name)
    return known


def _json(text: str, field: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise BadInput(Fault(field, f"is not JSON: {error}", shown_value(text))) from None


def _object(text: str, field: str) -> dict[str, Any]:
    value = _json(text, field)
    if not isinstance(value, dict):
        raise BadInput(Fault(field, "must hold one JSON object", shown_value(value)))
    return value


def _told(file: Path, answer: dict[str, Any]) -> str:
    frame, counts, attitude = answer["frame"], answer["counts"], answer["attitude"]
    found = (
        f"{file}: {frame['candidates']} candidates, {frame['used']} in the batch: "
        f"{counts['unique']} unique, {counts['ambiguous']} ambiguous, "
        f"{counts['unmatched']} unmatched"
    )
    lines = [found]
    if attitude is None:
        lines.append(f"  no attitude: {answer['reason']}")
    else:
        quaternion = " ".join(f"{each:.9f}" for each in attitude["quaternion"])
        covariance = attitude["covariance_arcsec2"]
        sigmas = " ".join(f"{math.sqrt(covariance[k][k]):.2f}" for k in range(3))
        lines.append(f"  {attitude['status']}  {quaternion}  sigma {sigmas} arcsec")
    return "\n".join([*lines, *(f"  {each}" for each in answer["warnings"]), f"  {answer['id']}"])


def _write_overlay(parsed: Namespace, file: Path, picture: bytes) -> None:
    target: Path = parsed.overlay
    if len(parsed.files) > 1 or target.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        target = target / f"{file.stem}.png"
    target.write_bytes(picture)


@contextmanager
def _desk(parsed: Namespace, settings: Settings) -> Iterator[Desk]:
    if parsed.in_process:
        from service.operations import Operations

        operations = Operations.open(settings)
        try:
            operations.ready()
            yield _InProcess(operations)
        finally:
            operations.close()
    else:
        import httpx

        headers = {} if settings.token is None else {"Authorization": f"Bearer {settings.token}"}
        # The service may listen to this machine alone, where no proxy reaches it.
        with httpx.Client(
            base_url=parsed.url, timeout=TIMEOUT_S, trust_env=False, headers=headers
        ) as client:
            yield _OverHttp(client)


class _InProcess:
    def __init__(self, operations: Any) -> None:
        self._operations = operations

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        from service.imaging.submit import read_known

        with file.open("rb") as opened:
            answered = self._operations.submit_frame(spacecraft, read_known(known), opened)
        body: bytes = answered.body
        return body

    def overlay(self, id: str) -> bytes:
        picture: bytes = self._operations.overlay(id)
        return picture


class _OverHttp:
    def __init__(self, client: Any) -> None:
        self._client = client

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        query = {
            name: value if name in TEXTS else json.dumps(value) for name, value in known.items()
        }
        return self._asked(
            "POST",
            f"/api/v1/spacecraft/{spacecraft}/frames",
            params=query,
            content=file.read_bytes(),
            headers={"Content-Type": FRAME_TYPE},
        )

    def overlay(self, id: str) -> bytes:
        return self._asked("GET", f"/api/v1/batches/{id}/overlay")

    def _asked(self, method: str, url: str, **asked: Any) -> bytes:
        import httpx

        try:
            response = self._client.request(method, url, **asked)
        except (httpx.TransportError, httpx.InvalidURL) as error:
            raise Busy(
                f"no service answers at {self._client.base_url} ({error}); "
                "start one with `acquire serve`, or work with --in-process"
            ) from None
        if response.is_success:
            return bytes(response.content)
        if response.status_code == 401:
            raise NotAdmitted("the service asks for a token: set ACQUIRE_TOKEN")
        try:
            detail = str(response.json()["detail"])
        except (ValueError, KeyError, TypeError):
            detail = f"HTTP {response.status_code}: {response.text[:200]}"
        raise Refused(detail)
