"""Tell systemd that the service is ready, that it is alive, and that it stops.

A unit of `Type=notify` names a socket in the environment (sd_notify(3)).  Without one
nothing is sent.
"""

import asyncio
import logging
import os
import socket

import anyio
import anyio.to_thread

from service.app.factory import App
from service.errors import AcquisitionError, Standby

log = logging.getLogger(__name__)

TRY_AGAIN_S = 1.0


async def report_to_supervisor(app: App) -> None:
    """Report ready once the service is, and then that it is alive as often as is asked.

    It runs until it is cancelled.  A loop that stands, or a writer's thread that does not
    go on, sends nothing more: systemd then restarts the service (`WatchdogSec`).
    """
    if "NOTIFY_SOCKET" not in os.environ:
        return
    # The handlers' own threads may all be at work.
    own = anyio.CapacityLimiter(1)
    while not await anyio.to_thread.run_sync(_is_ready, app, limiter=own):
        await asyncio.sleep(TRY_AGAIN_S)
    if app.single_writer.is_writing:
        notify_supervisor("READY=1\nSTATUS=ready")
    else:
        notify_supervisor("READY=1\nSTATUS=standing by")
        app.single_writer.when_writing(lambda: notify_supervisor("STATUS=ready"))
    every_s = int(os.environ.get("WATCHDOG_USEC", "0")) / 2e6
    while every_s > 0.0:
        try:
            app.submissions.require_alive()
        except AcquisitionError as error:
            log.error("no sign of life to systemd: %s", error)
        else:
            notify_supervisor("WATCHDOG=1")
        await asyncio.sleep(every_s)


def notify_supervisor(message: str) -> None:
    """Send lines such as `READY=1`; nothing where no socket is named."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    # A name that begins with @ is not in the file system.
    path = "\0" + address[1:] if address.startswith("@") else address
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            # A supervisor that reads nothing must not hold up the event loop.
            sender.setblocking(False)
            sender.connect(path)
            sender.sendall(message.encode())
    except OSError as error:
        log.warning("systemd is not told %r: %s", message, error)


def _is_ready(app: App) -> bool:
    try:
        app.service.ready()
    except Standby:
        # It has started: a supervisor that waits for more would end it.
        return True
    except Exception:  # the warm-up logs why, and the next call tries again
        return False
    return True
