"""Page about the service: health, versions, catalog, missions, credits."""

import resource
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from starlette.responses import Response

from service.app.factory import App
from service.errors import AcquisitionError
from service.storage.progress import WAIT_S
from service.times import recorded_utc, utc_now
from service.web.console.formatting import age, count, plural, size
from service.web.console.page import (
    PAGES,
    ContextDep,
    FromQuery,
    PageContext,
    PageQuery,
    console_page,
)
from service.web.requests.access import Policy

LEAST_FREE = 0.1
"""Free part of the disk, and of the memory, below which the page warns."""
MEMORY, OWN_MEMORY = Path("/proc/meminfo"), Path("/proc/self/statm")
"""Paths of files on memory, on Linux only; elsewhere the page has no line about memory."""
SLOW_QUEUE_S = 5.0
ENDS_SOON_S = 30 * 86_400.0


@dataclass(frozen=True)
class Check:
    """Health check: its subject, its state, and the remedy for a fault."""

    name: str
    value: str
    is_well: bool = True
    remedy: str = ""


@console_page("/about", "Service", Policy("read", "nothing"), position=80)
def about_page(query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """Page with the service's health, version, catalog, missions, database and credits."""
    about = context.app.service.about(context.caller.spacecraft)
    # Queues, machine and cache tell what others send: a token of some spacecraft sees none.
    sees_all = context.caller.spacecraft is None
    return context.rendered(
        "about.html.jinja",
        query.run,
        about=about,
        checks=list(_checks(context)) if sees_all else [],
        cache=context.app.zones.state() if sees_all else None,
        operation=[each for each in PAGES.values() if each.section == "/about" != each.path],
    )


def _checks(context: PageContext) -> Iterator[Check]:
    app = context.app
    yield _readiness(app)
    backlog, lag = app.submissions.backlog(), app.store.progress.lag()
    posts, writes = backlog.posts, backlog.writes
    yield Check(
        "batches that wait to be answered",
        f"{count(posts.queued)}, the oldest for {age(posts.oldest_s)}",
        posts.oldest_s < SLOW_QUEUE_S,
        "More is sent than this machine can compute: send less at a time.",
    )
    yield Check(
        "records that wait to be written",
        f"{count(writes.queued)}, the oldest for {age(writes.oldest_s)}",
        writes.oldest_s < SLOW_QUEUE_S,
        "The database is slow or busy: see its log and its disk.",
    )
    yield Check(
        "last write",
        "succeeded" if writes.succeeded else "failed",
        writes.succeeded,
        "See the log of the service: the disk may be full, or the database not reachable.",
    )
    yield Check(
        "failed writes since the start",
        count(writes.failed),
        not writes.failed,
        "Their senders were told, and send again; see the log of the service.",
    )
    yield Check(
        "trends and alarms",
        f"{plural(lag.results, 'result')}, {age(lag.seconds)} behind the batches",
        lag.seconds <= WAIT_S,
        "They catch up by themselves; until then the newest batches are missing in them.",
    )
    yield from context.panels("about_page")
    yield from _machine(app)
    yield from _ends(app)


def _readiness(app: App) -> Check:
    try:
        app.submissions.require_alive()
        app.service.ready()
    except AcquisitionError as error:
        return Check("ready for batches", str(error), False, "The log of the service says more.")
    return Check("ready for batches", "yes")


def _machine(app: App) -> Iterator[Check]:
    settings = app.context.settings
    url = app.context.store.url
    is_file = url.get_backend_name() == "sqlite" and url.database
    folders = {"database": Path(str(url.database)).parent} if is_file else {}
    if settings.archive_folder is not None:
        folders["archive"] = settings.archive_folder
    for name, folder in folders.items():
        if not folder.is_dir():
            continue
        disk = shutil.disk_usage(folder)
        yield Check(
            f"disk of the {name}",
            f"{size(disk.free)} of {size(disk.total)} free",
            disk.free > LEAST_FREE * disk.total,
            "Archive or prune old batches, or enlarge the disk.",
        )
    if MEMORY.is_file():
        own = int(OWN_MEMORY.read_text().split()[1]) * resource.getpagesize()
        lines = (line.split() for line in MEMORY.read_text().splitlines())
        kilobytes = {words[0].rstrip(":"): int(words[1]) for words in lines}
        total, available = (1024 * kilobytes[name] for name in ("MemTotal", "MemAvailable"))
        yield Check(
            "memory",
            f"{size(own)} used by this process; {size(available)} of {size(total)} available "
            "on the machine",
            available > LEAST_FREE * total,
            "Fewer replay processes (ACQUIRE_REPLAY_PROCESSES) or a smaller cache need less.",
        )


def _ends(app: App) -> Iterator[Check]:
    dates = app.expiries.dates()
    now = utc_now()
    ends = {"table of leap seconds": dates.leap_seconds}
    ends |= {f"token {each.name}": each.expires for each in dates.tokens[:3]}
    for name, moment in ends.items():
        left_s = (recorded_utc(moment).tai_ns - now.tai_ns) * 1e-9
        yield Check(
            name,
            f"until {moment[:10]}, {age(left_s)} left" if left_s > 0 else f"ended {moment[:10]}",
            left_s > ENDS_SOON_S,
            "Replace it before it ends; a newer version has a newer table of leap seconds.",
        )
