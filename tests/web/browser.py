"""A headless Chromium to look at pages with, driven over its DevTools socket."""

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any

from websockets.sync.client import connect

from tests.waiting import wait_until

_NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, _NAMES)), None)

_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
)


_LEFT = (
    "Inspected target navigated or closed",
    "Execution context was destroyed.",
    "Cannot find default execution context",
)


class PageLeft(Exception):
    """Another page was loaded while an expression was evaluated in this one."""


@contextmanager
def chromium(folder: Path) -> Iterator[str]:
    """A browser with its profile in a folder: the URL of its DevTools socket."""
    assert CHROMIUM is not None
    command = [CHROMIUM, *_FLAGS, f"--user-data-dir={folder}", "about:blank"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            noted = folder / "DevToolsActivePort"
            wait_until(lambda: noted.exists() and noted.read_text().count("\n") >= 1, 60.0)
            port, path = noted.read_text().split("\n")
            yield f"ws://127.0.0.1:{port}{path}"
        finally:
            process.terminate()


class Browser:
    """One page with cookies and a storage of its own; `complaints` holds what its console says."""

    def __init__(self, chromium: str) -> None:
        self.complaints: list[str] = []
        self._chromium = chromium
        self._numbers = count(1)
        self._stack = ExitStack()

    def __enter__(self) -> "Browser":
        try:
            self._open_page()
        except BaseException:
            self._stack.close()
            raise
        return self

    def _open_page(self) -> None:
        self._socket = self._stack.enter_context(connect(self._chromium, max_size=None))
        context = self.call("Target.createBrowserContext", disposeOnDetach=True)
        target = self.call("Target.createTarget", url="about:blank", **context)["targetId"]
        page = f"{self._chromium.partition('/devtools/')[0]}/devtools/page/{target}"
        self._socket = self._stack.enter_context(connect(page, max_size=None))
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def call(self, method: str, **parameters: Any) -> Any:
        """Ask the browser for something; what it says meanwhile is noted."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        self._socket.send(json.dumps(message))
        while True:
            heard = json.loads(self._socket.recv(timeout=30))
            if heard.get("id") == number:
                if heard.get("error", {}).get("message") in _LEFT:
                    raise PageLeft(heard["error"]["message"])
                assert "error" not in heard, heard
                return heard["result"]
            self._note(heard)

    def _note(self, heard: dict[str, Any]) -> None:
        kind, said = heard.get("method"), heard.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.complaints.append(str(said["exceptionDetails"]))
        elif kind == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.complaints.append(f"{said['entry']['text']} {said['entry'].get('url', '')}")
        elif kind == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning"):
            self.complaints.append(str(said["args"]))

    def open(self, url: str, width: int = 1440, height: int = 900, dark: bool = False) -> None:
        """Load a page in a window of that size."""
        self.show(width, height, dark)
        self.call("Page.navigate", url=url)
        self.wait(
            lambda: self.run("location.href !== 'about:blank' && document.readyState") == "complete"
        )

    def show(self, width: int = 1440, height: int = 900, dark: bool = False) -> None:
        """Give the window that size, and the page that scheme, without loading it again."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def picture(self, width: int, height: int, top: int = 0) -> bytes:
        """The page as PNG, from so many pixels below its top."""
        clip = {"x": 0, "y": top, "width": width, "height": height, "scale": 1}
        taken = self.call(
            "Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip
        )
        return base64.b64decode(taken["data"])

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        done = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def press(self, key: str) -> None:
        """Press and release a key such as Tab."""
        code = {"Tab": 9, "Enter": 13, "ArrowLeft": 37, "ArrowRight": 39}[key]
        text = {"Enter": "\r"}.get(key, "")
        for type_ in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=type_, key=key, windowsVirtualKeyCode=code, text=text
            )

    def drag(self, selector: str, start: float, end: float) -> None:
        """Drag the mouse across an element, from one part of its width to another."""
        script = (
            f"(e => {{ e.scrollIntoView({{block: 'center'}}); const b = e.getBoundingClientRect();"
            f"return [b.left, b.top + b.height / 2, b.width]; }})"
            f"(document.querySelector({json.dumps(selector)}))"
        )
        left, y, width = self.run(script)
        places = [left + width * (start + (end - start) * part / 4) for part in range(5)]
        kinds = ["mousePressed", *["mouseMoved"] * 4, "mouseReleased"]
        for kind, x in zip(kinds, [places[0], *places[1:], places[-1]], strict=True):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def wait(self, condition: Any, seconds: float = 30.0) -> None:
        """Return once the condition holds; it does not while another page is being loaded."""
        end = time.monotonic() + seconds
        while not self._holds(condition):
            if time.monotonic() > end:
                seen = self.run(
                    "[location.href, document.body.innerText.slice(0, 1000)].join(': ')"
                )
                raise AssertionError(f"waited in vain at {seen}")
            time.sleep(0.05)

    @staticmethod
    def _holds(condition: Any) -> bool:
        try:
            return bool(condition())
        except PageLeft:
            return False
