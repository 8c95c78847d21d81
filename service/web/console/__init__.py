"""The console: pages on which operators see how well stars are identified, and act on it."""

from fastapi import APIRouter

from service.web.console import pages as pages
from service.web.console.page import PAGES, PageRoute


def console_router() -> APIRouter:
    """API router with the routes of every registered page."""
    router = APIRouter(include_in_schema=False, route_class=PageRoute)
    for name, page in PAGES.items():
        router.add_api_route(page.path, page.handler, name=name)
    return router
