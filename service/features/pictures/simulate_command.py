"""Command `acquire simulate frames`: frames of a star tracker with known truth."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli import arguments
from service.features.pictures.frame_command import CAMERA_MISSION


def add(commands: Any) -> None:
    """Declare the command `simulate frames`."""
    group = arguments.commands_of(commands, "simulate")
    first = "--seed --format --prior-error --lost"
    parser = arguments.add_command(group, "frames", run, first=first)
    parser.add_argument("output", type=Path, metavar="OUTDIR", help="the folder to write")
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=CAMERA_MISSION)
    parser.add_argument(
        "--frames", required=True, type=arguments.count, metavar="N", help="number of frames"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument(
        "--tracker", metavar="NAME", help="default: the first tracker with a camera"
    )
    parser.add_argument(
        "--start",
        metavar="UTC",
        help="time of the first frame; default 2026-03-01; one frame per minute",
    )
    parser.add_argument(
        "--format", choices=("fits", "tiff", "png", "npy"), default="fits", help="default fits"
    )
    parser.add_argument(
        "--psf",
        choices=("gaussian", "airy", "cross"),
        help="the image of a star; default: that of the mission's camera",
    )
    prior = parser.add_mutually_exclusive_group()
    prior.add_argument(
        "--prior-error",
        type=float,
        default=1.0,
        metavar="DEG",
        help="maximum error of the a priori attitude; default 1",
    )
    prior.add_argument("--lost", action="store_true", help="no a priori attitude")
    parser.add_argument(
        "--rates",
        type=float,
        default=0.02,
        metavar="DEG/S",
        help="maximum body rate per axis; default 0.02",
    )
    parser.add_argument(
        "--response",
        type=float,
        default=0.005,
        metavar="SIGMA",
        help="standard deviation of the pixel response; default 0.005",
    )
    parser.add_argument(
        "--sky",
        type=float,
        default=100.0,
        metavar="E/S",
        help="sky background of a pixel; default 100",
    )
    parser.add_argument("--hot-pixels", type=int, default=200, metavar="N", help="default 200")
    parser.add_argument(
        "--cosmic-rays", type=int, default=5, metavar="N", help="mean number per frame; default 5"
    )


def run(parsed: Namespace) -> int:
    """Simulate frames of a star tracker with the real sky and all noise.  FILE.json holds the known
    data of FILE.fits; truth.ndjson holds the truth of all frames.

    acquire simulate frames --spacecraft IMAGER --frames 10 --seed 3 frames/
    acquire simulate frames --spacecraft IMAGER --frames 5 --psf cross --lost frames/
    acquire simulate frames --spacecraft IMAGER --frames 5 --rates 0.5 --cosmic-rays 50 frames/
    """
    from tqdm import tqdm

    from service.features.pictures.tracker.simulated import (
        DEFAULT_START,
        TRUTH,
        FrameSettings,
        draw_frames,
        write_frames,
    )
    from service.sky.cache import LruCache
    from service.sky.model import SkyModel

    mission, catalog = arguments.mission_and_catalog(parsed.spacecraft)
    wanted = FrameSettings(
        frames=parsed.frames,
        seed=parsed.seed,
        tracker=parsed.tracker,
        start=parsed.start or DEFAULT_START,
        psf=parsed.psf,
        a_priori_error_deg=None if parsed.lost else parsed.prior_error,
        rates_deg_per_s=parsed.rates,
        response_sigma=parsed.response,
        sky_e_per_s=parsed.sky,
        hot_pixels=parsed.hot_pixels,
        cosmic_rays=parsed.cosmic_rays,
    )
    drawn = draw_frames(mission, SkyModel(catalog, LruCache(64 << 20)), wanted)
    bar = tqdm(drawn, total=wanted.frames, unit="frame", disable=None)
    written = write_frames(bar, parsed.output, parsed.format)
    print(f"{parsed.output}: {written} frames of {mission.name}; truth: {parsed.output / TRUTH}")
    return 0
