"""Whether pages fit their window and axe finds no fault, in several views of one load."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests.web.browser import Browser

AXE = (Path(__file__).parent / "axe" / "axe.min.js").read_text(encoding="utf-8")
FAULTS = """axe.run(document, {resultTypes: ["violations"]}).then(found => found.violations
    .map(each => [each.id, each.nodes.map(node => node.html).slice(0, 3)]))"""
CHARTS_DRAWN = """document.getElementById("charts") === null
    || document.getElementById("charts").dataset.drawn !== undefined"""
VIEWS = ((400, True), (1440, False))
"""Width in pixels, and whether the scheme is dark; what is narrow first has room afterwards."""


def faults(browser: Browser) -> Any:
    """The violations that axe finds in the shown page."""
    if browser.run("typeof axe") == "undefined":
        browser.run(AXE + ";0")
    return browser.run(FAULTS)


def assert_fits(
    browser: Browser,
    url: str,
    views: Sequence[tuple[int, bool]] = VIEWS,
    ready: Callable[[], Any] | None = None,
) -> None:
    """Load a page once, and look at it in every view.

    `ready` says when the page is complete; by default that is when its charts are drawn.
    """
    (width, dark), *others = views
    browser.open(url, width=width, dark=dark)
    browser.wait(ready or (lambda: browser.run(CHARTS_DRAWN)))
    _assert_fits(browser, url, width, dark)
    for width, dark in others:
        browser.show(width=width, dark=dark)
        _assert_fits(browser, url, width, dark)


def _assert_fits(browser: Browser, url: str, width: int, dark: bool) -> None:
    assert browser.run("document.documentElement.scrollWidth") <= width, (url, width)
    found = faults(browser)
    assert found == [], (url, width, dark, found)
