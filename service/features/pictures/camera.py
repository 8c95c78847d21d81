"""Command `acquire camera`: calibrate a camera from pictures of the sky."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.arguments import add_command, add_group, settings_of
from service.errors import BadInput, Fault, printable, shown_value
from service.features.pictures.any_camera import add_camera_options, focal_guess_px, picture_reader

if TYPE_CHECKING:
    from service.features.pictures.blind.bright_stars import BrightStars
    from service.features.pictures.blind.picture import PictureResult
    from service.features.pictures.blind.solver import BlindSolver
    from service.features.pictures.camera_calibration import CameraCalibration
    from service.settings import Settings


def add(commands: Any) -> None:
    """Declare the command `camera` with `calibrate`."""
    group = add_group(
        commands,
        "camera",
        "Cameras: from pictures of the sky to a mission file.",
        "acquire camera calibrate pictures/*.jpg -o missions/mycam.toml",
    )
    parser = add_command(group, "calibrate", run)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="CAMERA.toml", help="mission file"
    )
    parser.add_argument("--name", metavar="NAME", help="mission name; default: from the output")
    add_camera_options(parser)


def run(parsed: Namespace) -> int:
    """Fit focal length, optical centre and radial distortion to pictures of the sky, measure star
    images, noise and zero point, and write the mission file of the camera.  A few pictures of
    different fields are enough; no information about them is needed.  Residual maps before and
    after are written beside the mission file.

    acquire camera calibrate pictures/*.jpg -o missions/mycam.toml
    acquire camera calibrate a.png b.png c.png --fov 12 --name MYCAM -o mycam.toml
    """
    from service.features.pictures.blind.picture import blind_sky
    from service.features.pictures.camera_calibration import calibrate_camera
    from service.sky.catalog.star_catalog import open_catalog

    settings = settings_of(parsed)
    sky, solver = blind_sky(open_catalog(settings.catalog))
    used = _solved(parsed, settings, sky, solver)
    if not used:
        message = "none of the pictures has an attitude: there is nothing to calibrate with"
        raise BadInput(Fault("FILE", message, shown_value(len(parsed.files))))
    stars = [
        sky.direction[[star.row for star in each.attitude.stars]] for each in used if each.attitude
    ]
    found = calibrate_camera(used, stars)
    name = _mission_name(parsed)
    _write_mission(parsed.output, name, found)
    maps = _write_maps(parsed.output, found)
    _print_result(found)
    print(f"{parsed.output}: mission {name}; residual maps: {maps[0]}, {maps[1]}")
    print(f"next: acquire frame PICTURE --spacecraft {parsed.output} --time UTC")
    return 0 if len(used) == len(parsed.files) else 1


def _solved(
    parsed: Namespace, settings: "Settings", sky: "BrightStars", solver: "BlindSolver"
) -> list["PictureResult"]:
    """Solve the pictures; reports those without an attitude or mirrored, and returns the others."""
    from service.features.pictures.blind.picture import solve_picture

    read = picture_reader(parsed.dark, settings)
    used: list[PictureResult] = []
    shape = None
    for file in parsed.files:
        try:
            frame = read(file, shape)
            guess_px = focal_guess_px(parsed, frame.width_px, frame.height_px)
            if used and used[0].attitude is not None:
                guess_px = used[0].attitude.lens.focal_px
            result = solve_picture(frame, sky, solver, guess_px, whole_only=True)
        except BadInput as error:
            print(f"acquire: {file}: {error}", file=sys.stderr)
            continue
        if result.attitude is None:
            reason = printable("; ".join(result.remarks))
            print(f"acquire: {file}: no attitude: {reason}", file=sys.stderr)
            continue
        if result.frame.is_mirrored:
            reason = "a mission file describes no mirrored sensor; mirror the pictures first"
            print(f"acquire: {file}: {result.frame.orientation}: {reason}", file=sys.stderr)
            continue
        shape = (frame.height_px, frame.width_px)
        used.append(result)
        print(f"{file}: {len(result.attitude.stars)} stars, {result.attitude.rms_px:.2f} px rms")
    return used


def _mission_name(parsed: Namespace) -> str:
    """Mission name from the option, or derived from the name of the output file."""
    stem: str = parsed.output.stem
    letters = "".join(each if each.isalnum() or each in "_-" else "_" for each in stem)
    return str(parsed.name or letters.lstrip("_-").upper() or "CAMERA")


def _write_mission(output: Path, name: str, found: "CameraCalibration") -> None:
    """Write the mission file of a camera, after checking that it can be read."""
    from service.features.pictures.camera_calibration import mission_text
    from service.missions.mission import parse_mission

    text = mission_text(name, found)
    parse_mission(text, str(output))
    output.write_text(text, encoding="utf-8")


def _write_maps(output: Path, found: "CameraCalibration") -> list[Path]:
    """Draw the residuals before and after calibration as PNG files next to the mission file."""
    from service.features.pictures.tracker.overlay import draw_residuals

    size, usual_px = (found.lens.width_px, found.lens.height_px), max(found.rms_px[1], 1e-3)
    # The first map has all stars, the second one only those used in the fit.
    drawn = {
        "before": (found.before_place_px, found.before_px),
        "after": (found.place_px, found.after_px),
    }
    maps = []
    for word, (place, residual) in drawn.items():
        path = output.with_name(f"{output.stem}-residuals-{word}.png")
        path.write_bytes(draw_residuals(place, residual, size, usual_px, word))
        maps.append(path)
    return maps


def _print_result(found: "CameraCalibration") -> None:
    lens = found.lens
    before, after = found.rms_px
    center_u, center_v = lens.center_px
    print(
        f"focal length {lens.focal_px:.2f} +- {found.sigma(0) * lens.focal_px:.2f} px, centre "
        f"({center_u:.1f}, {center_v:.1f}) +- {found.sigma(2) * lens.radius_px:.1f} px, "
        f"distortion {lens.bend * lens.radius_px:+.2f} +- {found.sigma(1) * lens.radius_px:.2f} "
        "px at the corners"
    )
    print(
        f"residuals {before:.3f} px rms with a focal length alone, {after:.3f} px fitted; places "
        f"were expected to {found.centroid_sigma_px:.3f} px"
    )
    print(
        f"star images {found.psf_sigma_px:.2f} px (one sigma), noise {found.noise_counts:.2f} "
        f"counts, zero point {found.zero_point_mag:.2f} mag"
    )
    for remark in found.remarks:
        print(printable(remark))
