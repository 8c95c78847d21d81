"""Solution of pictures from any camera in this process, for `acquire frame`."""

import json
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import to_builtins

from service.cli.arguments import degrees, positive
from service.errors import BadInput, Fault, printable, shown_value
from service.settings import Settings

if TYPE_CHECKING:
    from argparse import _ArgumentGroup as ArgumentGroup  # it has no public name

    from service.features.pictures.frames.frame import Frame

FEW_NAMES = 12
LEAST_MEGAPIXELS = 64
"""Least limit in megapixels for pictures on this computer, higher than for uploads."""


def add_lens_options(parser: ArgumentParser) -> None:
    """Declare the options for pictures without a spacecraft, whose lens is fitted."""
    lens = parser.add_argument_group(
        "without a spacecraft",
        "known data of any camera; values of its lens may be wrong by a quarter",
    )
    add_camera_options(lens)
    lens.add_argument(
        "--lens",
        choices=("gnomonic", "equidistant", "equisolid", "stereographic"),
        help="projection: gnomonic (on a plane) or of a fisheye; default: whatever fits",
    )
    lens.add_argument(
        "--pixel-ratio",
        type=positive,
        metavar="RATIO",
        help="width of a pixel over its height; default: from the FITS header, else 1",
    )


def add_camera_options(options: "ArgumentParser | ArgumentGroup") -> None:
    """Declare the options that `focal_guess_px` and `picture_reader` take."""
    options.add_argument(
        "--fov", type=degrees, metavar="DEG", help="field of view, the longer side"
    )
    options.add_argument("--focal-px", type=positive, metavar="PX", help="focal length in pixels")
    options.add_argument("--focal-mm", type=positive, metavar="MM", help="with --pixel-um")
    options.add_argument("--pixel-um", type=positive, metavar="UM", help="the pitch of the pixels")
    options.add_argument(
        "--dark", type=Path, metavar="FILE", help="a frame of the same exposure without light"
    )


def refuse_lens_options(parsed: Namespace) -> None:
    """Raise `BadInput` for data of a lens that are given beside a spacecraft."""
    for name in ("fov", "lens", "pixel_ratio", "focal_px", "focal_mm", "pixel_um", "dark"):
        value = getattr(parsed, name)
        if value is not None:
            message = "goes without --spacecraft; a mission's file describes its camera"
            raise BadInput(Fault(f"--{name.replace('_', '-')}", message, shown_value(str(value))))


def solve_pictures(parsed: Namespace, settings: Settings) -> int:
    """Solve each picture file and print its result; returns 1 if any fails, otherwise 0."""
    from service.features.pictures.blind.picture import blind_sky, solve_picture
    from service.features.pictures.blind.square_pixels import require_ratio
    from service.features.pictures.overlay import overlay_of
    from service.features.pictures.records import picture_of
    from service.sky.catalog.star_catalog import open_catalog

    targets = overlay_files(parsed)
    sky, solver = blind_sky(open_catalog(settings.catalog))
    read = picture_reader(parsed.dark, settings, parsed.image)
    failed = 0
    for file in parsed.files:
        try:
            frame = read(file, None)
            if parsed.pixel_ratio is not None:
                ratio = require_ratio(parsed.pixel_ratio, "--pixel-ratio")
                frame = replace(frame, pixel_ratio=ratio)
            guess_px = focal_guess_px(parsed, frame.width_px, frame.height_px)
            result = solve_picture(frame, sky, solver, guess_px, projection=parsed.lens)
        except BadInput as error:
            failed += 1
            print(f"acquire: {file}: {error}", file=sys.stderr)
            continue
        failed += result.attitude is None
        report = {"file": str(file), **to_builtins(picture_of(result)), "overlay": None}
        report.pop("overlay_png")
        unwritten = None
        try:
            write_overlay(parsed, targets[file], overlay_of(result, file.name))
            report["overlay"] = str(targets[file])
        except OSError as error:
            unwritten = f"the picture cannot be written: {error.filename}: {error.strerror}"
        print(json.dumps(report) if parsed.json else _summary(file, report))
        if unwritten is not None:
            # The attitude is found all the same.
            failed += 1
            print(f"acquire: {file}: {unwritten}", file=sys.stderr)
    return 1 if failed else 0


def picture_reader(
    dark_file: Path | None, settings: Settings, image: str | None = None
) -> "Callable[[Path, tuple[int, int] | None], Frame]":
    """Create a function that reads a picture, checks its shape and subtracts the dark frame."""
    from service.features.pictures.detection.points import without_dark
    from service.features.pictures.frames.files import read_frame
    from service.features.pictures.frames.frame import FrameLimits

    max_pixels = 1_000_000 * max(settings.frame_megapixels, LEAST_MEGAPIXELS)

    def read(file: Path, shape: tuple[int, int] | None) -> "Frame":
        chosen = image if file != dark_file else None
        limits = FrameLimits(max_pixels, shape, "the first picture", chosen)
        with file.open("rb") as opened:
            frame = read_frame(opened, limits)
        return frame if dark is None else without_dark(frame, dark)

    dark: Frame | None = None
    if dark_file is not None:
        dark = read(dark_file, None)
    return read


def focal_guess_px(parsed: Namespace, width_px: int, height_px: int) -> float | None:
    """Approximate focal length in pixels from the options; None without any."""
    from service.features.pictures.blind.picture import focal_px_of_field

    if parsed.focal_px is not None:
        return float(parsed.focal_px)
    if (parsed.focal_mm is None) != (parsed.pixel_um is None):
        message = "--focal-mm and --pixel-um go together: one says nothing without the other"
        raise BadInput(Fault("--focal-mm", message, shown_value(parsed.focal_mm)))
    if parsed.focal_mm is not None:
        return 1000.0 * float(parsed.focal_mm) / float(parsed.pixel_um)
    if parsed.fov is not None:
        side_px = max(width_px, height_px)
        return focal_px_of_field(side_px, parsed.fov, getattr(parsed, "lens", None), "--fov")
    return None


def _summary(file: Path, report: dict[str, Any]) -> str:
    found = report["attitude"]
    lines = [f"{file}: {report['candidates']} candidates, " + _matched(report)]
    if found is not None:
        lens = report["lens"]
        q = " ".join(f"{each:.6f}" for each in found["quaternion"])
        sigma = " ".join(f"{each:.1f}" for each in found["sigma_arcsec"])
        width, height = lens["field_deg"]
        unit = "one count" if report["exposure_s"] is None else "one count a second"
        lines.append(
            f"  RA {found['ra_deg']:.4f} deg  Dec {found['dec_deg']:+.4f} deg  roll "
            f"{found['roll_deg']:.3f} deg (of the upper edge, from north through east)"
        )
        lines.append(f"  pixels {report['orientation']}")
        lines.append(
            f"  quaternion {q}  (ICRS to camera, scalar last: x right, y down, z to the sky)"
        )
        lines.append(
            f"  {found['status']} (the lens is not calibrated)  sigma {sigma} arcsec about x, y, "
            f"z; scaled by the residuals, {report['residual_rms_px']:.2f} px rms, with "
            f"{report['shared_error_px']:.2f} px that more stars would not take away; aberration "
            f"{found['aberration']}"
        )
        projection = lens["projection"]
        kind = "" if projection == "gnomonic" else f", {projection} projection"
        lines.append(
            f"  field {width:.3f} x {height:.3f} deg{kind}, focal length {lens['focal_px']:.1f} "
            f"+- {lens['focal_sigma_px'] or 0.0:.1f} px, star images "
            f"{report['psf_sigma_px']:.1f} px (one sigma)"
        )
        if report["zero_point_mag"] is not None:
            lines.append(
                f"  zero point {report['zero_point_mag']:.2f} mag for {unit}, "
                f"scatter {report['zero_point_sigma_mag'] or 0.0:.2f} mag"
            )
        names = [
            f"{each['name'] or each['id']} {each['v_mag']:.1f}"
            for each in report["stars"][:FEW_NAMES]
        ]
        lines.append(
            "  " + ", ".join(names) + (", ..." if len(report["stars"]) > FEW_NAMES else "")
        )
    lines += [f"  {printable(each)}" for each in report["remarks"]]
    if report["overlay"] is not None:
        lines.append(f"  picture: {report['overlay']}")
    return "\n".join(lines)


def _matched(report: dict[str, Any]) -> str:
    return (
        "no attitude" if report["attitude"] is None else f"{len(report['stars'])} stars identified"
    )


def overlay_files(parsed: Namespace) -> dict[Path, Path]:
    """The file that each picture's overlay is written to, by the picture's file.

    `--overlay` names a file, or a folder for several pictures; without it FILE-stars.png in the
    current folder. Raises `BadInput` where an overlay would replace another, or a picture.
    """
    overlay: Path | None = parsed.overlay
    is_folder = overlay is not None and (len(parsed.files) > 1 or overlay.is_dir())
    read = [*parsed.files, *filter(None, [parsed.dark])]
    pictures = {file.resolve(): file for file in read}
    targets: dict[Path, Path] = {}
    owners: dict[Path, Path] = {}
    for file in parsed.files:
        if overlay is None:
            target = Path(f"{file.stem}-stars.png")
        else:
            target = overlay / f"{file.stem}.png" if is_folder else overlay
        replaced = pictures.get(target.resolve())
        if replaced is not None:
            message = f"would replace the picture {replaced}; name another place with --overlay"
            raise BadInput(Fault("--overlay", message, shown_value(str(target))))
        owner = owners.setdefault(target.resolve(), file)
        if owner.resolve() != file.resolve():
            message = f"would be the overlay of both {owner} and {file}; send them one by one"
            raise BadInput(Fault("--overlay", message, shown_value(str(target))))
        targets[file] = target
    return targets


def write_overlay(parsed: Namespace, target: Path, picture: bytes) -> None:
    """Write an overlay to its file, for several pictures into a folder that is made."""
    if len(parsed.files) > 1:
        target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(picture)
