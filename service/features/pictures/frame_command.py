"""Command `acquire frame`: detect stars on frames, identify them, and solve for the attitude."""

import json
import math
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Protocol

from service.cli import arguments
from service.errors import AcquisitionError, BadInput, Busy, Fault, Unauthenticated, shown_value
from service.features.pictures import any_camera
from service.settings import Settings

CAMERA_MISSION = "IMAGER, or one of your own whose tracker has a camera, or its file (.toml)"
SIDECAR = """\
The metadata of a frame are in a JSON file of its name beside it, FILE.json for
FILE.fits or FILE.fits.gz, as `acquire simulate frames` writes it: the fields of a batch
except its stars (time, a_priori, body_rates_deg_per_s, ...).  Options of the command
override them."""


def add(commands: Any) -> None:
    """Declare the command `frame`."""
    parser = arguments.add_command(
        commands,
        "frame",
        run,
        notes=SIDECAR,
        first="--spacecraft --fov --a-priori --overlay --url --in-process",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--spacecraft", metavar="NAME", help=CAMERA_MISSION)
    parser.add_argument(
        "--tracker", metavar="NAME", help="default: the first tracker with a camera"
    )
    parser.add_argument(
        "--time",
        metavar="UTC",
        help="time of mid exposure; default: from FILE.json, else from the FITS header",
    )
    parser.add_argument(
        "--batch",
        metavar="ID",
        help="batch id of a single frame; default: from FILE.json, else from the file's digest",
    )
    parser.add_argument("--run", metavar="NAME", help="default: from FILE.json, else live")
    parser.add_argument(
        "--a-priori", metavar="JSON", help="JSON as in a batch; null: search the whole sky"
    )
    parser.add_argument(
        "--centroid",
        choices=("window", "scan", "matched", "recursive"),
        help="default: the mission's method",
    )
    parser.add_argument(
        "--image",
        metavar="NAME",
        help="which image of a file with several: name or number of a FITS unit, :2 for the second "
        "plane of a cube, the number of an image of TIFF, PNG, GIF, JPEG (MPO) or .npy",
    )
    arguments.add_url_or_in_process(parser)
    parser.add_argument(
        "--overlay",
        type=Path,
        metavar="OUT.png",
        help="write an image of the frame with stars, names and residuals; for several frames, "
        "a folder",
    )
    parser.add_argument("--json", action="store_true", help="print the answers, one per line")
    arguments.add_database(parser)
    any_camera.add_lens_options(parser)


def run(parsed: Namespace) -> int:
    """Detect the stars in frames and pictures (FITS, TIFF, PNG, JPEG, GIF, BMP, PGM, raw, .npy),
    identify them and solve for the attitude.  Frames of a spacecraft are recorded; one that is
    sent again returns the first answer.  Without a spacecraft a picture may be from any camera:
    its lens is fitted with the attitude, nothing is recorded, and the overlay is FILE-stars.png.

    acquire frame holiday.jpg                    any camera, any lens
    acquire frame holiday.jpg --focal-mm 50 --pixel-um 4.8 --overlay stars.png
    acquire frame frames/*.fits --spacecraft IMAGER --overlay pictures/
    acquire frame one.fits --spacecraft IMAGER --in-process --overlay one.png
    acquire frame one.png --spacecraft IMAGER --time 2026-03-01T00:00:00Z --json
    """
    if parsed.spacecraft is None:
        return any_camera.solve_pictures(parsed, arguments.settings_of(parsed))
    any_camera.refuse_lens_options(parsed)
    if parsed.batch is not None and len(parsed.files) > 1:
        message = "names one frame; leave it out for several"
        raise BadInput(Fault("--batch", message, shown_value(parsed.batch)))
    if parsed.database is not None and not parsed.in_process:
        message = "goes with --in-process; a running service has its own"
        raise BadInput(Fault("--database", message, shown_value(parsed.database)))
    targets = any_camera.overlay_files(parsed) if parsed.overlay else {}
    refused = 0
    with frame_submitter(parsed, arguments.settings_of(parsed)) as submitter:
        for file in parsed.files:
            try:
                body = submitter.submit(parsed.spacecraft, _known(parsed, file), file)
            except (BadInput, FrameRefused) as error:
                refused += 1
                print(f"acquire: {file}: {error}", file=sys.stderr)
                continue
            answer = json.loads(body)
            print(body.decode() if parsed.json else _summary(file, answer))
            if parsed.overlay is not None:
                picture = submitter.overlay(answer["id"])
                any_camera.write_overlay(parsed, targets[file], picture)
    return 1 if refused else 0


def _known(parsed: Namespace, file: Path) -> dict[str, Any]:
    """Metadata of a frame: from the JSON file next to it, overridden by options."""
    known: dict[str, Any] = {}
    plain = file.with_name(file.name.removesuffix(".gz").removesuffix(".fz"))
    beside = plain.with_suffix(".json")
    if beside.is_file():
        known = _object(beside.read_text(encoding="utf-8-sig"), str(beside))
    if parsed.a_priori is not None:
        known["a_priori"] = _json(parsed.a_priori, "--a-priori")
    for name in ("tracker", "time", "batch", "run", "centroid", "image"):
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


def _summary(file: Path, answer: dict[str, Any]) -> str:
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


FRAME_TYPE = "application/octet-stream"
TEXTS = ("batch", "time", "run", "tracker", "aberration", "centroid", "image")
TIMEOUT_S = 120.0


class FrameSubmitter(Protocol):
    """Processor of frames: a running service, or this process."""

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        """Submit a frame; returns the answer as JSON.  Raises `BadInput` or `FrameRefused`."""

    def overlay(self, id: str) -> bytes:
        """Picture of a result with its identified stars marked, as PNG."""


class FrameRefused(AcquisitionError):
    """Raised if the service refuses a frame, with the message of the service."""


@contextmanager
def frame_submitter(parsed: Namespace, settings: Settings) -> Iterator[FrameSubmitter]:
    """Context manager of the frame processor chosen by the options."""
    if parsed.in_process:
        from service.app.factory import open_app

        with closing(open_app(settings)) as app:
            app.service.ready()
            yield _InProcess(app)
    else:
        with arguments.http_client(settings, arguments.service_url(parsed), TIMEOUT_S) as client:
            yield _OverHttp(client)


class _InProcess:
    def __init__(self, app: Any) -> None:
        self._app = app

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        from service.features.pictures.part import Pictures
        from service.features.pictures.tracker.submit import read_known

        with file.open("rb") as opened:
            frames = self._app.part(Pictures).frames
            answered = frames.submit(spacecraft, read_known(known), opened)
        body: bytes = answered.body
        return body

    def overlay(self, id: str) -> bytes:
        from service.features.pictures.part import Pictures

        picture: bytes = self._app.part(Pictures).frames.overlay(id)
        return picture


class _OverHttp:
    def __init__(self, client: Any) -> None:
        self._client = client

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        query = {
            name: value if name in TEXTS else json.dumps(value) for name, value in known.items()
        }
        return self._request(
            "POST",
            f"/api/v1/spacecraft/{spacecraft}/frames",
            params=query,
            content=file.read_bytes(),
            headers={"Content-Type": FRAME_TYPE},
        )

    def overlay(self, id: str) -> bytes:
        return self._request("GET", f"/api/v1/batches/{id}/overlay")

    def _request(self, method: str, url: str, **request: Any) -> bytes:
        import httpx

        try:
            response = self._client.request(method, url, **request)
        except (httpx.TransportError, httpx.InvalidURL) as error:
            raise Busy(
                f"no service answers at {self._client.base_url} ({error}); "
                "start one with `acquire serve`, or work with --in-process"
            ) from None
        if response.is_success:
            return bytes(response.content)
        if response.status_code == 401:
            raise Unauthenticated("the service asks for a token: set ACQUIRE_TOKEN")
        raise FrameRefused(arguments.refusal_of(response))
