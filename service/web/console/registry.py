"""The registry of console pages: routes, navigation, titles and access policies derive from it.

A page is a module that calls `console_page`; see `service.web.console.pages`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from service.web.requests.access import POLICIES, Policy

Handler = Callable[..., Any]


@dataclass(frozen=True)
class ConsolePage:
    """A page of the console.

    `section` is the path of the navigation entry that is marked on the page.
    `position` orders the entries of the navigation; a page without one has no entry.
    """

    path: str
    title: str
    section: str
    position: int | None
    handler: Handler


PAGES: dict[str, ConsolePage] = {}
"""Every page by the name of its route."""


def console_page(
    path: str, title: str, policy: Policy, *, section: str = "", position: int | None = None
) -> Callable[[Handler], Handler]:
    """Register the decorated handler as the page at `path`."""

    def register(handler: Handler) -> Handler:
        PAGES[handler.__name__] = ConsolePage(path, title, section or path, position, handler)
        POLICIES[handler.__name__] = policy
        return handler

    return register


def navigation() -> list[ConsolePage]:
    """The pages of the navigation, in its order."""
    return sorted(
        (page for page in PAGES.values() if page.position is not None),
        key=lambda page: page.position or 0,
    )
