"""The console: pages that show operators how well stars are identified, and let them act."""

from fastapi import APIRouter

from service.web.dashboard import (
    about,
    advice_page,
    alarms,
    batch,
    batches,
    compare,
    limits,
    missions,
    overview,
    runs,
    sign_in,
    spacecraft,
    zones,
)

PAGES: tuple[APIRouter, ...] = (
    overview.router,
    alarms.router,
    limits.router,
    compare.router,
    spacecraft.router,
    advice_page.router,
    batches.router,
    batch.router,
    runs.router,
    zones.router,
    missions.router,
    about.router,
    sign_in.router,
)
"""Every page's routes, in the order of the menu."""
