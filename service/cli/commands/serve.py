"""Commands `acquire serve`, which runs the service, and `acquire prepare`, which readies it."""

import faulthandler
import gc
from argparse import Namespace
from typing import Any

from service.cli.arguments import add_command, add_database, settings_of

NOTES = """\
The service does the same when it starts; several processes that need a part build it once. The
missions and the star catalog are those of ACQUIRE_MISSIONS and ACQUIRE_CATALOG. The exit code is 1
if the files cannot be written: the service works without them, but each start takes longer."""


def add(commands: Any) -> None:
    """Declare the commands `serve` and `prepare`."""
    parser = add_command(commands, "serve", run)
    parser.add_argument(
        "--host",
        help="address to listen on; one that is not loopback requires a token; default: "
        "ACQUIRE_HOST, else 127.0.0.1",
    )
    parser.add_argument("--port", type=int, help="default: ACQUIRE_PORT, else 8000")
    add_database(parser)
    parser = add_command(commands, "prepare", prepare, notes=NOTES)
    parser.add_argument(
        "--time", metavar="UTC", help="of the batches that the sky is for; default: now"
    )


def run(parsed: Namespace) -> int:
    """Serve the API and the console.  Creates and migrates an SQLite file if needed.

    acquire serve
    acquire serve --port 8100 --database sqlite:///night.db
    """
    # Nearly everything loaded at the start stays: looking for garbage takes a sixth of the
    # start.  `ready` enables collection again.
    gc.disable()
    settings = settings_of(parsed)
    if not faulthandler.is_enabled():
        # A fault in compiled code ends the process; the handler prints where.
        faulthandler.enable()
    from service import logs
    from service.settings import require_free

    require_free(settings.host, settings.port)
    logs.configure(settings.logs, "server")
    from service.web.server import serve as serve_forever

    serve_forever(settings)
    return 0


def prepare(parsed: Namespace) -> int:
    """Compile the kernels and build the files of the sky (run catalogs, indexes of the whole sky),
    unless they are there.

    acquire prepare
    acquire prepare --time 1999-03-01T00:00:00Z
    """
    import logging
    import time

    from service.acquire.kernel_build import KernelBuild, progress_logged
    from service.acquire.prewarm import prewarm_sky
    from service.missions.mission import load_missions
    from service.sky.cache import LruCache
    from service.sky.catalog.star_catalog import open_catalog
    from service.sky.files import folder, is_kept
    from service.sky.model import SkyModel
    from service.times import parse_utc, utc_now

    logging.basicConfig(format="%(message)s", level=logging.INFO)
    moment = utc_now() if parsed.time is None else parse_utc(parsed.time, "--time")
    settings = settings_of(parsed)
    missions = load_missions(*settings.mission_places, shipped=settings.ships_missions)
    build = KernelBuild()
    if build.is_needed:
        print("kernels: compiling for a minute or two", flush=True)
        start = time.monotonic()
        with progress_logged(logging.getLogger(__name__)):
            build.run(missions)
        print(f"kernels: compiled in {time.monotonic() - start:.0f} s")
    else:
        print("kernels: compiled already")

    start, before = time.monotonic(), set(folder().glob("*.npy"))
    sky = SkyModel(open_catalog(settings.catalog), LruCache(settings.shelf_mb << 20))
    prewarm_sky(sky, missions.values(), moment)
    built = len(set(folder().glob("*.npy")) - before)
    keys = [entry.key for entry in sky.cache.state().entries]
    # The cache's keys are of any type; those of this sky are pairs of kind and key.
    kept = sum(is_kept(*key) for key in keys)  # type: ignore[misc]
    done = f"{built} files built in {time.monotonic() - start:.1f} s" if built else "built already"
    print(f"sky: {done}\nfolder: {folder().parent}")
    return 0 if kept == len(keys) else 1
