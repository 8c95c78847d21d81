"""`acquire frame` without a spacecraft: pictures from any camera, solved in this process."""

import json
import math
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import BadInput, Fault, shown_value
from service.settings import Settings

if TYPE_CHECKING:
    from service.acquire.picture import PictureResult
    from service.imaging.frames.frame import Frame

FEW_NAMES = 12
LEAST_MEGAPIXELS = 64
"""A picture on this computer may be larger than what a service accepts from a client."""


def solve_pictures(parsed: Namespace, settings: Settings) -> int:
    """Solve every file and print its result; 1 where one was refused or has no attitude."""
    from service.acquire.picture import blind_sky, solve_picture
    from service.sky.catalog.star_catalog import open_catalog

    sky, solver = blind_sky(open_catalog(settings.catalog))
    read = picture_reader(parsed.dark, settings, parsed.image)
    failed = 0
    for file in parsed.files:
        try:
            frame = read(file, None)
            guess_px = focal_guess_px(parsed, frame.width_px, frame.height_px)
            result = solve_picture(frame, sky, solver, guess_px)
        except BadInput as error:
            failed += 1
            print(f"acquire: {file}: {error}", file=sys.stderr)
            continue
        failed += result.attitude is None
        told = {"file": str(file), **result_json(result), "overlay": None}
        unwritten = None
        try:
            told["overlay"] = str(_write_overlay(parsed, file, result))
        except OSError as error:
            unwritten = f"the picture cannot be written: {error.filename}: {error.strerror}"
        print(json.dumps(told) if parsed.json else _summary(file, told))
        if unwritten is not None:
            # The attitude is found all the same.
            failed += 1
            print(f"acquire: {file}: {unwritten}", file=sys.stderr)
    return 1 if failed else 0


def picture_reader(
    dark_file: Path | None, settings: Settings, image: str | None = None
) -> "Callable[[Path, tuple[int, int] | None], Frame]":
    """A function that reads a picture, of a shape if one is given, less the dark frame."""
    from service.imaging.frames.dark import without_dark
    from service.imaging.frames.files import read_frame
    from service.imaging.frames.frame import FrameLimits

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
    """The rough focal length that the options tell, None without any."""
    from service.identify.blind.solver import focal_px_of

    if parsed.focal_px is not None:
        return float(parsed.focal_px)
    if (parsed.focal_mm is None) != (parsed.pixel_um is None):
        message = "--focal-mm and --pixel-um go together: one says nothing without the other"
        raise BadInput(Fault("--focal-mm", message, shown_value(parsed.focal_mm)))
    if parsed.focal_mm is not None:
        return 1000.0 * float(parsed.focal_mm) / float(parsed.pixel_um)
    if parsed.fov is not None:
        return focal_px_of(max(width_px, height_px), parsed.fov)
    return None


def result_json(result: "PictureResult") -> dict[str, Any]:
    """A result ready for JSON; numbers that are not known are null."""
    points, found = result.points, result.attitude
    told: dict[str, Any] = {
        "width_px": points.width_px,
        "height_px": points.height_px,
        "candidates": points.count,
        "psf_sigma_px": round(points.psf_sigma_px, 2),
        "noise_counts": round(points.noise_counts, 3),
        "attitude": None,
        "orientation": result.frame.orientation,
        "remarks": [*result.remarks, *result.frame.remarks],
    }
    if found is None:
        return told
    lens, ra_dec = found.lens, found.boresight_deg
    told["attitude"] = {
        # The lens was fitted on the picture itself: it is not calibrated.
        "status": "suspect",
        "quaternion": [round(each, 9) for each in found.quaternion.tolist()],
        "sigma_arcsec": [round(each, 2) for each in found.sigma_arcsec.tolist()],
        "ra_deg": round(ra_dec[0], 5),
        "dec_deg": round(ra_dec[1], 5),
        "roll_deg": round(found.roll_deg, 4),
        "aberration": "corrected" if found.aberration_corrected else "ignored: no time is known",
        "log_odds": round(found.log_odds, 1),
    }
    told["lens"] = {
        "field_deg": [round(each, 4) for each in found.field_deg],
        "focal_px": round(lens.focal_px, 2),
        "focal_sigma_px": _known(found.sigma_of(3) * lens.focal_px, 2),
        "distortion_corner": round(lens.bend, 6),
        "distortion_sigma": _known(found.sigma_of(4), 6),
        "center_px": [round(each, 2) for each in lens.center_px],
        "center_sigma_px": _known(found.sigma_of(5) * lens.radius_px, 2),
    }
    told["residual_rms_px"] = round(found.rms_px, 3)
    told["sigma_scale"] = round(found.sigma_scale, 3)
    told["shared_error_px"] = round(found.shared_px, 3)
    told["zero_point_mag"] = _known(found.zero_point_mag, 2)
    told["zero_point_sigma_mag"] = _known(found.zero_point_sigma_mag, 2)
    told["exposure_s"] = result.frame.exposure_s
    told["stars"] = [
        {
            "id": star.id,
            "name": star.name,
            "v_mag": round(star.magnitude_v_mag, 2),
            "u_px": round(star.u_px, 2),
            "v_px": round(star.v_px, 2),
            "residual_px": [round(star.residual_u_px, 3), round(star.residual_v_px, 3)],
        }
        for star in found.stars
    ]
    return told


def _known(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _summary(file: Path, told: dict[str, Any]) -> str:
    found = told["attitude"]
    lines = [f"{file}: {told['candidates']} candidates, " + _matched(told)]
    if found is not None:
        lens = told["lens"]
        q = " ".join(f"{each:.6f}" for each in found["quaternion"])
        sigma = " ".join(f"{each:.1f}" for each in found["sigma_arcsec"])
        width, height = lens["field_deg"]
        unit = "one count" if told["exposure_s"] is None else "one count a second"
        lines.append(
            f"  RA {found['ra_deg']:.4f} deg  Dec {found['dec_deg']:+.4f} deg  roll "
            f"{found['roll_deg']:.3f} deg (of the upper edge, from north through east)"
        )
        lines.append(f"  pixels {told['orientation']}")
        lines.append(
            f"  quaternion {q}  (ICRS to camera, scalar last: x right, y down, z to the sky)"
        )
        lines.append(
            f"  {found['status']} (the lens is not calibrated)  sigma {sigma} arcsec about x, y, "
            f"z; scaled by the residuals, {told['residual_rms_px']:.2f} px rms, with "
            f"{told['shared_error_px']:.2f} px that more stars would not take away; aberration "
            f"{found['aberration']}"
        )
        lines.append(
            f"  field {width:.3f} x {height:.3f} deg, focal length {lens['focal_px']:.1f} "
            f"+- {lens['focal_sigma_px'] or 0.0:.1f} px, star images {told['psf_sigma_px']:.1f} px "
            "(one sigma)"
        )
        if told["zero_point_mag"] is not None:
            lines.append(
                f"  zero point {told['zero_point_mag']:.2f} mag for {unit}, "
                f"scatter {told['zero_point_sigma_mag'] or 0.0:.2f} mag"
            )
        names = [
            f"{each['name'] or each['id']} {each['v_mag']:.1f}"
            for each in told["stars"][:FEW_NAMES]
        ]
        lines.append("  " + ", ".join(names) + (", ..." if len(told["stars"]) > FEW_NAMES else ""))
    lines += [f"  {each}" for each in told["remarks"]]
    if told["overlay"] is not None:
        lines.append(f"  picture: {told['overlay']}")
    return "\n".join(lines)


def _matched(told: dict[str, Any]) -> str:
    return "no attitude" if told["attitude"] is None else f"{len(told['stars'])} stars identified"


def _write_overlay(parsed: Namespace, file: Path, result: "PictureResult") -> Path:
    from service.acquire.picture import overlay_of

    target: Path = parsed.overlay or Path(f"{file.stem}-stars.png")
    if parsed.overlay is not None and (len(parsed.files) > 1 or target.is_dir()):
        target.mkdir(parents=True, exist_ok=True)
        target = target / f"{file.stem}.png"
    target.write_bytes(overlay_of(result, file.name))
    return target
