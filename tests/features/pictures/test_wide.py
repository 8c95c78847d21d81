"""Pictures of very wide lenses, and of pixels that are not square, of which nothing is told."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.cli import main
from service.features.pictures.blind.lens import PARAMETERS, PROJECTIONS, Lens, lens_of, linearised
from service.features.pictures.blind.picture import solve_picture
from service.features.pictures.blind.solver import focal_px_of
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.fits import write_fits
from service.features.pictures.frames.frame import Frame, FrameLimits
from service.vectors import attitude_error_arcsec, rotate_about
from tests.features.pictures.trailed import add_path
from tests.scale import draws

RADIUS = {
    "gnomonic": math.tan,
    "equidistant": float,
    "equisolid": lambda angle: 2.0 * math.sin(0.5 * angle),
    "stereographic": lambda angle: 2.0 * math.tan(0.5 * angle),
}
WIDTH, HEIGHT, PSF_PX, NOISE = 1200, 800, 1.2, 7.0


YEAR = 2026


def drawn(sky, kind, field_deg, faintest_mag, seed, stretch=(1.0, 1.0)):
    """A picture through a lens, with its truth; `stretch` is of the pixels along u and v."""
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed).as_matrix()
    counts = rng.normal(100.0, NOISE, (round(HEIGHT * stretch[1]), round(WIDTH * stretch[0])))
    height, width = counts.shape
    scale_px = 0.5 * WIDTH / RADIUS[kind](math.radians(0.5 * field_deg))
    bright = sky.magnitude_mag < faintest_mag
    body = sky.direction[bright] @ attitude.T
    light = 126.0 * NOISE * 10.0 ** (0.4 * (faintest_mag - sky.magnitude_mag[bright]))
    for (x, y, z), flux in zip(body.tolist(), light.tolist(), strict=True):
        angle = math.acos(max(min(z, 1.0), -1.0))
        if angle > (1.5 if kind == "gnomonic" else 2.5):
            continue
        radius_px = scale_px * RADIUS[kind](angle) / max(math.hypot(x, y), 1e-9)
        u = 0.5 * (width - 1) + stretch[0] * radius_px * x
        v = 0.5 * (height - 1) + stretch[1] * radius_px * y
        if -9.0 < u < width + 9.0 and -9.0 < v < height + 9.0:
            add_path(counts, np.array([u]), np.array([v]), PSF_PX, np.array([flux]))
    return Frame(counts.astype(np.float32), "NPY", "sha256:0", math.inf), attitude


def assert_right(result, attitude, word):
    error = attitude_error_arcsec(result.attitude.attitude, attitude)
    assert np.hypot(*error[:2]) < 60.0
    assert np.all(np.abs(error) < 4.0 * result.attitude.sigma_arcsec)
    assert any(each.startswith(word) for each in result.remarks)


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize(
    ("kind", "field_deg", "faintest_mag"),
    [
        ("gnomonic", 100, 5.5),
        ("equidistant", 140, 5.5),
        ("stereographic", 140, 5.5),
        ("equisolid", 180, 5.0),
        ("equidistant", 180, 5.0),
    ],
)
def test_a_lens_too_wide_for_the_search_is_solved_from_its_middle(
    blind, kind, field_deg, faintest_mag, told
):
    frame, attitude = drawn(blind[0], kind, field_deg, faintest_mag, 5)
    guess_px = focal_px_of(WIDTH, 1.1 * field_deg, kind) if told and field_deg < 160 else None
    projection = kind if told else None
    result = solve_picture(frame, *blind, guess_px, projection=projection)
    # A plane whose width is told needs no look at its middle.
    is_plain = kind == "gnomonic" and told
    assert_right(result, attitude, "" if is_plain else f"wide_lens: a lens of {kind} projection")
    lens = result.attitude.lens
    assert lens.projection == kind
    assert result.attitude.field_deg[0] == pytest.approx(field_deg, abs=0.05)
    assert lens.focal_px == pytest.approx(focal_px_of(WIDTH, field_deg, kind), rel=1e-3)
    assert abs(lens.bend) < 2e-3
    far = [np.hypot(s.u_px - WIDTH / 2, s.v_px - HEIGHT / 2) for s in result.attitude.stars]
    assert max(far) > 0.9 * lens.radius_px


def test_a_fisheye_is_solved_mirrored_too_and_another_projection_is_refused(blind):
    frame, attitude = drawn(blind[0], "equidistant", 160, 5.0, 8)
    mirror = replace(frame, counts=frame.counts[:, ::-1])
    for projection in (None, "equidistant"):
        result = solve_picture(mirror, *blind, projection=projection)
        assert_right(result, attitude, "wide_lens: ")
        assert "mirrored" in result.frame.orientation
    refused = solve_picture(frame, *blind, projection="stereographic")
    assert refused.attitude is None
    assert refused.remarks[0].startswith("no_match: ")


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_places_and_directions_of_a_projection_are_each_other_s(projection, rng):
    widest_deg = 90.0 if projection == "gnomonic" else 170.0
    lens = Lens(WIDTH, HEIGHT, focal_px_of(WIDTH, widest_deg, projection), 0.01, 0.01, -0.02)
    lens = replace(lens, projection=projection)
    u, v = rng.uniform(0, WIDTH - 1, 200), rng.uniform(0, HEIGHT - 1, 200)
    u[0], v[0] = lens.center_px
    body = lens.directions(u, v)
    assert np.linalg.norm(body, axis=1) == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(lens.places(body), (u, v), rtol=0, atol=1e-9)
    assert np.arccos(body[:, 2]).max() < lens.reach_rad
    attitude = Rotation.random(random_state=1).as_matrix()
    star, free = body @ attitude, np.array([0.0, 0.01, 0.01, -0.02])
    _, jacobian = linearised(lens, PARAMETERS, free, attitude, u, v, star)
    for k in range(7):
        moved = []
        for step in (-1e-6, 1e-6):
            turned = rotate_about(step * np.eye(3)[k], attitude.T).T if k < 3 else attitude
            changed = lens_of(lens, PARAMETERS, free + step * np.eye(7)[k][3:])
            plane = changed.plane(u, v) - changed.projected(star @ turned.T)
            moved.append((plane * lens.focal_px).ravel())
        slope = (moved[0] - moved[1]) / 2e-6
        assert np.abs(jacobian[:, k] - slope).max() < 1e-6 * np.abs(slope).max()


@pytest.mark.parametrize("stretch", [(2.0, 1.0), (1.0, 0.5)])
def test_pixels_binned_along_one_side_only_are_solved(blind, stretch):
    frame, attitude = drawn(blind[0], "gnomonic", 40, 6.0, 6, stretch)
    assert_right(solve_picture(frame, *blind), attitude, "unequal_pixels: ")


@pytest.mark.parametrize("stretch", [(1.3, 1.0), (1.0, 0.7)])
def test_pixels_of_any_stated_ratio_are_solved(blind, stretch):
    """Wider or higher by a share that no averaging of pairs makes square."""
    frame, attitude = drawn(blind[0], "gnomonic", 40, 6.0, 6, stretch)
    told = replace(frame, pixel_ratio=stretch[1] / stretch[0])
    guess_px = focal_px_of(WIDTH, 40.0)
    assert_right(solve_picture(told, *blind, guess_px), attitude, "unequal_pixels: ")


def test_a_wrong_ratio_of_a_header_does_no_harm(blind):
    frame, attitude = drawn(blind[0], "gnomonic", 40, 6.0, 6)
    found = solve_picture(replace(frame, pixel_ratio=1.5), *blind)
    assert not any(each.startswith("unequal_pixels") for each in found.remarks)
    assert attitude_error_arcsec(found.attitude.attitude, attitude).max() < 60.0


@pytest.mark.parametrize(
    ("cards", "ratio"),
    [
        ({"XPIXSZ": 9.0, "YPIXSZ": 4.5}, 2.0),
        ({"XBINNING": 1, "YBINNING": 2, "XPIXSZ": 5.0, "YPIXSZ": 5.0}, 0.5),
        ({"XPIXSZ": 5.0, "YPIXSZ": 5.0}, None),
        ({"XPIXSZ": 0.0, "YPIXSZ": 5.0}, None),
        ({"XPIXSZ": "wide", "YPIXSZ": 5.0, "XBINNING": True, "YBINNING": 2}, None),
    ],
)
def test_the_ratio_of_pixel_sides_is_read_from_a_header(cards, ratio):
    file = io.BytesIO()
    counts = np.arange(480, dtype=np.uint16).reshape(20, 24)
    write_fits(file, counts, cards)
    file.seek(0)
    assert read_frame(file, FrameLimits(1_000)).pixel_ratio == ratio


def test_clear_points_that_are_no_sky_get_a_plain_sentence(blind):
    rng = np.random.default_rng(7)
    counts = rng.normal(100.0, NOISE, (HEIGHT, WIDTH))
    for u, v in rng.uniform(10.0, 790.0, (60, 2)).tolist():
        add_path(counts, np.array([u]), np.array([v]), PSF_PX, np.array([3000.0]))
    result = solve_picture(Frame(counts.astype(np.float32), "NPY", "x", math.inf), *blind)
    assert result.attitude is None
    assert any("the lens may be too wide (--lens NAME)" in each for each in result.remarks)


@pytest.mark.parametrize("projection", [None, *PROJECTIONS])
def test_points_at_random_have_no_attitude_behind_any_lens(blind, projection, rng):
    for _ in range(draws(1, 12)):
        counts = rng.normal(100.0, NOISE, (HEIGHT, WIDTH))
        for _ in range(int(rng.integers(30, 120))):
            u, v = rng.uniform(10.0, WIDTH - 10.0, 1), rng.uniform(10.0, HEIGHT - 10.0, 1)
            add_path(counts, u, v, PSF_PX, 126.0 * NOISE * 10.0 ** rng.uniform(0.0, 1.6, 1))
        frame = Frame(counts.astype(np.float32), "NPY", "x", math.inf)
        result = solve_picture(frame, *blind, projection=projection)
        assert result.attitude is None
        assert any(each.startswith("no_match: ") for each in result.remarks)


def test_the_image_circle_of_a_fisheye_is_solved_as_a_whole(blind):
    """A circle of 147 degrees within the height; what is outside is black."""
    frame, attitude = drawn(blind[0], "equisolid", 280, 5.0, 9)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    scale_px = focal_px_of(WIDTH, 280, "equisolid")
    outside = np.hypot(u - 0.5 * (WIDTH - 1), v - 0.5 * (HEIGHT - 1)) > scale_px * 1.2
    frame = replace(frame, counts=np.where(outside, np.float32(3.0), frame.counts))
    result = solve_picture(frame, *blind, projection="equisolid")
    assert_right(result, attitude, "wide_lens: a lens of equisolid projection")


def test_the_command_offers_every_projection(capsys):
    with pytest.raises(SystemExit):
        main(["frame", "--help"])
    assert f"{{{','.join(PROJECTIONS)}}}" in capsys.readouterr().out
