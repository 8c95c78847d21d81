"""Ways to submit a frame: over HTTP, or in this process."""

import json
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from service.cli.configuration import service_url
from service.errors import AcquisitionError, Busy, Unauthenticated
from service.settings import Settings

FRAME_TYPE = "application/octet-stream"
TEXTS = ("batch", "time", "run", "tracker", "aberration", "centroid", "image")
TIMEOUT_S = 120.0


class FrameSubmitter(Protocol):
    """Takes frames: a running service, or this process."""

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        """Submit a frame and return the answer's JSON; raises `BadInput` or `FrameRefused`."""

    def overlay(self, id: str) -> bytes:
        """The overlay of a result as PNG."""


class FrameRefused(AcquisitionError):
    """The service refused a frame; the message is its own."""


@contextmanager
def frame_submitter(parsed: Namespace, settings: Settings) -> Iterator[FrameSubmitter]:
    """The way that the arguments choose, open while the block runs."""
    if parsed.in_process:
        from service.app.factory import open_app

        app = open_app(settings)
        try:
            app.service.ready()
            yield _InProcess(app)
        finally:
            app.close()
    else:
        import httpx

        headers = {} if settings.token is None else {"Authorization": f"Bearer {settings.token}"}
        # The service may listen to this machine alone, where no proxy reaches it.
        with httpx.Client(
            base_url=service_url(parsed), timeout=TIMEOUT_S, trust_env=False, headers=headers
        ) as client:
            yield _OverHttp(client)


class _InProcess:
    def __init__(self, app: Any) -> None:
        self._app = app

    def submit(self, spacecraft: str, known: dict[str, Any], file: Path) -> bytes:
        from service.imaging.submit import read_known

        with file.open("rb") as opened:
            answered = self._app.frames.submit(spacecraft, read_known(known), opened)
        body: bytes = answered.body
        return body

    def overlay(self, id: str) -> bytes:
        picture: bytes = self._app.frames.overlay(id)
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

    def _request(self, method: str, url: str, **arguments: Any) -> bytes:
        import httpx

        try:
            response = self._client.request(method, url, **arguments)
        except (httpx.TransportError, httpx.InvalidURL) as error:
            raise Busy(
                f"no service answers at {self._client.base_url} ({error}); "
                "start one with `acquire serve`, or work with --in-process"
            ) from None
        if response.is_success:
            return bytes(response.content)
        if response.status_code == 401:
            raise Unauthenticated("the service asks for a token: set ACQUIRE_TOKEN")
        try:
            detail = str(response.json()["detail"])
        except (ValueError, KeyError, TypeError):
            detail = f"HTTP {response.status_code}: {response.text[:200]}"
        raise FrameRefused(detail)
