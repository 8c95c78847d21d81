"""What can be asked of the commands about frames."""

from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.cli.checks import count

LOCAL = "http://127.0.0.1:8000"
TRACKED = "IMAGER, or one of your own whose tracker has a camera"
SIDECAR = """\
What is known of a frame stands in a JSON file of its name beside it, FILE.json for
FILE.fits, as `acquire simulate frames` writes it: the fields of a batch but its stars
(time, a_priori, body_rates_deg_per_s, ...).  Options of the command come first."""

Command = Callable[..., ArgumentParser]


def add_frame_command(commands: Any, command: Command, add_database: Any) -> None:
    """`acquire frame`."""
    parser = command(
        commands,
        "frame",
        "Find the stars on frames of a star tracker (FITS, TIFF, PNG, .npy), identify them, solve "
        "for the attitude, and record it all.  The same frame again gives the first answer again.",
        """
        acquire frame frames/*.fits --spacecraft IMAGER --overlay pictures/
        acquire frame one.fits --spacecraft IMAGER --in-process --overlay one.png
        acquire frame one.png --spacecraft IMAGER --time 2026-03-01T00:00:00Z --json
        """,
        "frame",
    )
    parser.epilog = f"{parser.epilog}\n\n{SIDECAR}"
    add = parser.add_argument
    add("files", nargs="+", type=Path, metavar="FILE")
    add("--spacecraft", required=True, metavar="NAME", help=TRACKED)
    add("--tracker", metavar="NAME", help="default: the first that has a camera")
    add("--time", metavar="UTC", help="of mid exposure; default: FILE.json, else the FITS header")
    add("--batch", metavar="ID", help="of one frame; default: FILE.json, else from its digest")
    add("--run", metavar="NAME", help="default: FILE.json, else live")
    add("--a-priori", metavar="JSON", help="as in a batch; null: lost in space")
    add(
        "--centroid",
        choices=("window", "scan", "matched", "recursive"),
        help="default: the mission's",
    )
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--url", default=LOCAL, help=f"the service; default {LOCAL}")
    way.add_argument("--in-process", action="store_true", help="without a server, in this process")
    add(
        "--overlay",
        type=Path,
        metavar="OUT.png",
        help="the frame with its stars, names and residuals; of several frames a folder",
    )
    add("--json", action="store_true", help="print the answers, one a line")
    add_database(parser)


def add_simulated_frames_command(group: Any, command: Command) -> None:
    """`acquire simulate frames`."""
    parser = command(
        group,
        "frames",
        "Draw frames of a star tracker from the real sky, with all their noise.  Each FILE.fits "
        "has what would be known of it in FILE.json; the truth of all is in truth.ndjson.",
        """
        acquire simulate frames --spacecraft IMAGER --frames 10 --seed 3 frames/
        acquire simulate frames --spacecraft IMAGER --frames 5 --psf cross --lost frames/
        acquire simulate frames --spacecraft IMAGER --frames 5 --rates 0.5 --cosmic-rays 50 frames/
        """,
        "simulate_frames",
    )
    add = parser.add_argument
    add("output", type=Path, metavar="OUTDIR")
    add("--spacecraft", required=True, metavar="NAME", help=TRACKED)
    add("--frames", required=True, type=count, metavar="N")
    add("--seed", type=int, default=1, metavar="S", help="default 1")
    add("--tracker", metavar="NAME", help="default: the first that has a camera")
    add("--start", metavar="UTC", help="of the first frame; default 2026-03-01; one a minute")
    add("--format", choices=("fits", "tiff", "png", "npy"), default="fits", help="default fits")
    add(
        "--psf",
        choices=("gaussian", "airy", "cross"),
        default="gaussian",
        help="the image of a star; default gaussian",
    )
    prior = parser.add_mutually_exclusive_group()
    prior.add_argument(
        "--prior-error", type=float, default=1.0, metavar="DEG", help="at most; default 1"
    )
    prior.add_argument("--lost", action="store_true", help="no a priori attitude at all")
    add("--rates", type=float, default=0.02, metavar="DEG/S", help="at most, per axis; 0.02")
    add(
        "--response",
        type=float,
        default=0.005,
        metavar="SIGMA",
        help="scatter of the pixels' response; default 0.005",
    )
    add("--sky", type=float, default=100.0, metavar="E/S", help="of a pixel; default 100")
    add("--hot-pixels", type=int, default=200, metavar="N", help="default 200")
    add("--cosmic-rays", type=int, default=5, metavar="N", help="a frame, on average; default 5")
