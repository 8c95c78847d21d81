"""What follows from a camera's size and field of view: a mission file of a few lines made whole."""

import math
from typing import Any

import numpy as np

UNKNOWN_FIELD_DEG = 40.0
"""Of a camera whose file tells neither field of view nor focal length: room for most lenses."""
UNKNOWN_LIMIT_MAG = 7.0
ROOM = 1.3
"""By so much a field that is told roughly may be wider."""
WANTED_STARS = 40
STARS_TO_MAG = ((4.0, 516), (5.0, 1610), (6.0, 4999), (7.0, 15495), (8.0, 45598), (9.0, 130172))
"""How many stars of the sky are brighter than a magnitude."""
SIGMA_PX, ROUGH_SIGMA_PX = 0.3, 1.0
LARGEST_PAIR_DEG = 8.0


def with_camera_defaults(table: dict[str, Any]) -> dict[str, Any]:
    """The tables of a mission; of a file with a `camera` of its own, those that it leaves out.

    The camera needs `width_px` and `height_px`.  Its scale may be told by
    `focal_length_px`, then it counts as calibrated, or roughly by `field_of_view_deg`, along
    the longer side, or `focal_length_mm` with `pixel_um`, or not at all: then the lens
    is fitted on every frame.  What is wrong with the values is left to the mission's check.
    """
    camera = table.get("camera")
    if not isinstance(camera, dict) or "trackers" in table:
        return table
    camera = dict(camera)
    try:
        focal_px, scale_key = _focal_px(camera)
        width, height = float(camera["width_px"]), float(camera["height_px"])
        if not (min(width, height) >= 16 and 10 <= focal_px < 1e8):
            raise ValueError
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        # Refused in the mission's own words.
        return {**table, "trackers": [{"name": "CAMERA", "camera": camera}]} | {"camera": camera}
    exact = scale_key == "focal_length_px"
    room = 1.0 if exact else ROOM
    radius_deg = math.degrees(math.atan(0.5 * math.hypot(width, height) / focal_px * 1.05)) * room
    short_deg = 2.0 * math.degrees(math.atan(0.5 * min(width, height) / focal_px))
    long_deg = 2.0 * math.degrees(math.atan(0.5 * max(width, height) / focal_px))
    pixel_deg = math.degrees(1.0 / focal_px)
    limit_mag = _limit_mag(short_deg * long_deg) if scale_key else UNKNOWN_LIMIT_MAG
    rest = {key: value for key, value in table.items() if key != "camera"}
    return {
        "zone": {
            "kind": "cap",
            "axis_body": [0.0, 0.0, 1.0],
            "radius_deg": round(min(1.3 * radius_deg + 1.0, 90.0), 2),
        },
        "tolerances": {
            "pair_separation_max_deg": round(min(LARGEST_PAIR_DEG, long_deg), 2),
            "separation_deg": round(3.0 * pixel_deg, 5),
            "magnitude_mag": 1.0,
            "magnitude_order_mag": 1.0,
            "cross_product_deg": 90.0,
        },
        "catalog": {"magnitude_limit_mag": limit_mag},
        **rest,
        "trackers": [
            {
                "name": "CAMERA",
                "x_axis_body": [1.0, 0.0, 0.0],
                "y_axis_body": [0.0, 1.0, 0.0],
                "z_axis_body": [0.0, 0.0, 1.0],
                "field_of_view_radius_deg": round(min(radius_deg, 60.0), 3),
                "sigma_arcsec": round(
                    (SIGMA_PX if exact else ROUGH_SIGMA_PX) * 3600.0 * pixel_deg, 2
                ),
                "magnitude_sigma_mag": 0.3,
                "camera": {
                    "center_u_px": 0.5 * (width - 1.0),
                    "center_v_px": 0.5 * (height - 1.0),
                    "gain_e_per_count": 1.0,
                    "read_noise_e": 0.0,
                    "saturation_counts": 1e9,
                    "exposure_s": 1.0,
                    "psf_sigma_px": 1.2,
                    "sigma_floor_px": 0.1,
                    "calibrated": exact,
                    **{key: value for key, value in camera.items() if key not in _SCALES},
                    "focal_length_px": focal_px,
                },
            }
        ],
    }


_SCALES = ("focal_length_px", "field_of_view_deg", "focal_length_mm", "pixel_um")


def _focal_px(camera: dict[str, Any]) -> tuple[float, str | None]:
    """The focal length in pixels, and what told it."""
    if "focal_length_px" in camera:
        return float(camera["focal_length_px"]), "focal_length_px"
    if "focal_length_mm" in camera or "pixel_um" in camera:
        return 1000.0 * float(camera["focal_length_mm"]) / float(camera["pixel_um"]), "focal_mm"
    scale_key = "field_of_view_deg" if "field_of_view_deg" in camera else None
    field_deg = float(camera.get("field_of_view_deg", UNKNOWN_FIELD_DEG))
    if not 0.0 < field_deg < 150.0:
        raise ValueError
    side = max(float(camera["width_px"]), float(camera["height_px"]))
    return 0.5 * side / math.tan(math.radians(0.5 * field_deg)), scale_key


def _limit_mag(field_deg2: float) -> float:
    """The magnitude to which a field of view holds the wanted number of stars on average."""
    wanted = math.log(WANTED_STARS * 41253.0 / field_deg2)
    magnitudes, counts = zip(*STARS_TO_MAG, strict=True)
    return round(float(np.interp(wanted, np.log(counts), magnitudes)), 1)
