"""The addresses of the console's pages, from the registry."""

from service.web.console import pages as pages
from service.web.console.page import PAGES

WITHOUT_CONTENT = ("latest_batch", "sign_in_page")
"""A redirect, and the page before there is a reader."""


def console_addresses() -> list[str]:
    """Every page that needs no id; of spacecraft that of XTE, of problems one."""
    return [
        page.path.format(name="XTE", slug="bad-input")
        for name, page in PAGES.items()
        if name not in WITHOUT_CONTENT and "{id}" not in page.path
    ]
