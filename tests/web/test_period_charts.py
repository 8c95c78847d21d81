"""The geometry of the charts of a period, against astropy and scipy and what was put in."""

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from service.sky.zones import SearchRegion
from service.storage.queries.period import PeriodAttitudes, PeriodStars, TrackerStarsOfPeriod
from service.times import parse_utc, shifted
from service.vectors import angle_between_deg, from_ra_dec, quaternion_from_matrix
from service.web.console.charts.all_sky import EDGE, HEIGHT, WIDTH, all_sky_chart, hammer
from service.web.console.charts.attitude import attitude_charts
from service.web.console.charts.focal_plane import LONGEST, focal_plane_map
from service.web.console.charts.histogram import magnitude_chart, residual_histogram

START = parse_utc("1999-03-01T00:00:00Z")
ARCSEC = np.radians(1 / 3600)


def tracker_of(rng, count=4000, *, noise=1.0, **other):
    """A tracker of radius 4 deg with stars all over it, and the noise that is expected, or more."""
    place = rng.uniform(-2.8, 2.8, (count, 2))
    catalog = rng.uniform(3.0, 6.0, count)
    values = {
        "tracker": "ST",
        "field_of_view_radius_deg": 4.0,
        "sigma_arcsec": 2.0,
        "boresight": np.array([[1.0, 0.0, 0.0]]),
        "place_deg": place,
        "residual_arcsec": rng.normal(0.0, 2.0 * noise, (count, 2)),
        "expected_arcsec": np.full((count, 2), 2.0),
        "observed_mag": catalog + rng.normal(0.3, 0.1, count),
        "catalog_mag": catalog,
        "region": None,
    }
    return TrackerStarsOfPeriod(**values | other)


def attitudes_of(rotations, step_s=10.0, sigma_arcsec=1.0, **other):
    count = len(rotations)
    values = {
        "time_ns": np.array([shifted(START, k * step_s).tai_ns for k in range(count)]),
        "time": tuple(shifted(START, k * step_s).text for k in range(count)),
        "status": ("good",) * count,
        "quaternion": np.array([quaternion_from_matrix(each.as_matrix().T) for each in rotations]),
        "covariance_arcsec2": np.tile(np.eye(3) * sigma_arcsec**2, (count, 1, 1)),
        "follows": np.arange(count) > 0,
    }
    return PeriodAttitudes(**values | other)


def points_of(path):
    """The lines of a path in absolute places."""
    return [
        np.array([[float(x) for x in each.split()] for each in part.split("L")])
        for part in path.split("M")[1:]
    ]


# ---- the sky -------------------------------------------------------------------------------------


def test_the_projection_is_the_equal_area_one_of_fits(rng):
    """Hammer-Aitoff (AIT) of astropy's WCS, to a thousandth of a pixel."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---AIT", "DEC--AIT"]
    wcs.wcs.crval, wcs.wcs.crpix = [180.0, 0.0], [0.0, 0.0]
    # The whole ellipse is 4 sqrt(2) radians wide.
    per_px = np.degrees(4.0 * np.sqrt(2.0)) / WIDTH
    wcs.wcs.cdelt = [-per_px, per_px]
    ra, dec = rng.uniform(0, 360, 500), np.degrees(np.arcsin(rng.uniform(-1, 1, 500)))
    x, y = wcs.wcs_world2pix(ra, dec, 0)
    own = hammer(from_ra_dec(ra, dec))
    wanted = np.stack([x + 1 + EDGE + WIDTH / 2, EDGE + HEIGHT / 2 - (y + 1)], axis=1)
    assert own == pytest.approx(wanted, abs=1e-3)


def sky_of(rng, boresight, status=None, region=None):
    count = len(boresight)
    attitudes = attitudes_of(Rotation.identity(count), status=status or ("good",) * count)
    tracker = tracker_of(rng, 10, boresight=boresight, region=region)
    sun = np.tile(from_ra_dec(342.0, -7.6), (count, 1))
    period = PeriodStars(count, attitudes, (tracker,), 0, sun, START, START)
    return all_sky_chart(period, [tracker])


def test_the_galactic_plane_and_centre_are_those_of_astropy(rng):
    chart = sky_of(rng, from_ra_dec([10.0], [0.0]))
    plane = SkyCoord(l=np.arange(0, 360, 0.05), b=0, unit="deg", frame="galactic").icrs
    wanted = hammer(from_ra_dec(plane.ra.deg, plane.dec.deg))
    drawn = np.concatenate(points_of(chart.galactic))
    apart = np.linalg.norm(drawn[:, None] - wanted[None], axis=2)
    assert apart.min(axis=1).max() < 0.5
    centre = SkyCoord(l=0, b=0, unit="deg", frame="galactic").icrs
    assert chart.galactic_centre == pytest.approx(
        hammer(from_ra_dec(centre.ra.deg, centre.dec.deg)), abs=0.05
    )


def test_no_line_crosses_the_chart_where_the_projection_is_cut(rng):
    """Circles over the seam and about a pole, and a track over the seam."""
    track = from_ra_dec(np.linspace(340.0, 380.0, 41), np.full(41, 20.0))
    for axis in (from_ra_dec(2.0, 10.0), from_ra_dec(200.0, 80.0), from_ra_dec(1.0, 85.0)):
        chart = sky_of(rng, track, region=SearchRegion("band", axis, 60.0, 70.0))
        for path in (chart.zones[0].path, chart.galactic, chart.tracks[0].line, chart.grid):
            steps = [np.linalg.norm(np.diff(each, axis=0), axis=1) for each in points_of(path)]
            # Two degrees of a line are at most about eight pixels at the edge of the chart.
            assert max(step.max(initial=0.0) for step in steps) < 40.0


def test_a_zone_is_drawn_at_its_angle_from_its_axis(rng):
    axis = from_ra_dec(150.0, -30.0)
    chart = sky_of(rng, axis[None], region=SearchRegion("cap", axis, 0.0, 10.0))
    drawn = np.concatenate(points_of(chart.zones[0].path))
    around = from_ra_dec(*np.meshgrid(np.arange(130, 170, 0.2), np.arange(-45, -15, 0.2)))
    at = np.abs(angle_between_deg(around, axis) - 10.0) < 0.15
    wanted = hammer(around[at])
    assert np.linalg.norm(drawn[:, None] - wanted[None], axis=2).min(axis=1).max() < 1.0


def test_marks_and_counts_tell_outcomes_apart(rng):
    boresight = from_ra_dec([100.0, 110.0, 120.0, 0.0], [0.0, 0.0, 0.0, 0.0])
    boresight[3] = np.nan
    status = ("good", "suspect", "no_attitude", "no_attitude")
    (track,) = sky_of(rng, boresight, status).tracks
    assert track.counts == {"good": 1, "suspect": 1, "no_attitude": 2}
    assert track.without_place == 1
    assert [path.count("M") for path in (track.good, track.suspect, track.no_attitude)] == [1, 1, 1]
    assert track.last_ra_dec_deg == pytest.approx((120.0, 0.0))
    expected = SkyCoord(100, 0, unit="deg").separation(SkyCoord(342, -7.6, unit="deg")).deg
    assert track.least_sun_angle_deg == pytest.approx(expected)


# ---- residuals -----------------------------------------------------------------------------------


def test_noise_alone_gives_no_clear_arrow_and_no_shade(rng):
    drawn = focal_plane_map(tracker_of(rng))
    assert drawn.spread == pytest.approx(1.0, abs=0.05)
    # Each with one chance in three hundred.
    assert sum(cell.is_clear for cell in drawn.cells) <= 2
    assert {cell.shade for cell in drawn.cells if cell.stars > 50} == {0}
    assert sum(cell.stars for cell in drawn.cells) == 4000


def test_a_distortion_of_one_corner_is_found_there_with_its_size(rng):
    plain = tracker_of(rng)
    corner = (plain.place_deg[:, 0] > 0.0) & (plain.place_deg[:, 1] < -1.0)
    moved = plain.residual_arcsec + np.where(corner[:, None], [3.0, -1.5], 0.0)
    drawn = focal_plane_map(replace(plain, residual_arcsec=moved))
    for cell in drawn.cells:
        inside = cell.h_deg > 0.0 and cell.v_deg < -1.0
        if cell.stars > 20:
            assert cell.is_clear == inside, cell
        if cell.stars > 20 and inside:
            assert cell.mean_arcsec == pytest.approx((3.0, -1.5), abs=1.0)
            start, step = re.match(r"M(\S+) (\S+)l(\S+) ([^M]+)", cell.arrow).groups()[1:3]
            assert float(step) > 0.0, start


def test_a_noisy_tracker_is_shaded_but_not_said_to_be_distorted(rng):
    drawn = focal_plane_map(tracker_of(rng, noise=4.0))
    assert drawn.spread == pytest.approx(4.0, rel=0.05)
    assert {cell.shade for cell in drawn.cells if cell.stars > 50} == {4}
    assert sum(cell.is_clear for cell in drawn.cells) <= 2


def test_the_histogram_counts_as_numpy_and_its_normal_is_that_of_scipy(rng):
    tracker = tracker_of(rng, noise=2.5)
    drawn = residual_histogram(tracker)
    values = (tracker.residual_arcsec / tracker.expected_arcsec).ravel()
    assert drawn.spread == pytest.approx(2.5, rel=0.05)
    assert drawn.below == np.sum(values < -5.0)
    assert drawn.above == np.sum(values > 5.0)
    assert sum(bar.count for bar in drawn.bars) + drawn.below + drawn.above == drawn.count
    for bar in drawn.bars:
        assert bar.count == np.sum((values >= bar.low) & (values < bar.high))
        wanted = drawn.count * (norm.cdf(bar.high) - norm.cdf(bar.low))
        assert bar.expected == pytest.approx(wanted)


def test_magnitudes_show_their_offset_at_every_brightness(rng):
    drawn = magnitude_chart(tracker_of(rng))
    assert drawn.offset_mag == pytest.approx(0.3, abs=0.02)
    assert drawn.spread_mag == pytest.approx(0.1, abs=0.02)
    assert [row.low_mag for row in drawn.rows] == [3.0, 4.0, 5.0]
    for row in drawn.rows:
        assert row.offset_mag == pytest.approx(0.3, abs=0.03)
    assert sum(row.stars for row in drawn.rows) == 4000


def test_without_values_there_is_no_chart(rng):
    nothing = tracker_of(
        rng,
        20,
        residual_arcsec=np.full((20, 2), np.nan),
        expected_arcsec=np.full((20, 2), np.nan),
        observed_mag=np.full(20, np.nan),
    )
    assert focal_plane_map(nothing) is None
    assert residual_histogram(nothing) is None
    assert magnitude_chart(nothing) is None
    empty = attitudes_of(Rotation.identity(2), quaternion=np.full((2, 4), np.nan))
    assert attitude_charts(empty, START, shifted(START, 60.0)) == []


def length_of(path):
    """Length of the first line of an arrow's path."""
    found = re.match(r"M\S+ \S+?l(\S+) ([^M]+)", path)
    return np.hypot(*map(float, found.groups())) if found else 0.0


def test_a_wrong_star_leaves_the_arrows_of_all_others_readable(rng):
    """It is drawn as long as an arrow may be, and its residual stands beside."""
    plain = tracker_of(rng, 2000)
    before = focal_plane_map(plain)
    residual = plain.residual_arcsec.copy()
    residual[0] = [2991.0, 0.0]
    drawn = focal_plane_map(replace(plain, residual_arcsec=residual))
    (wrong,) = [each for each in drawn.cells if each.is_cut and each.mean_arcsec[0] > 20.0]
    assert drawn.cut_arcsec[0] == pytest.approx(np.hypot(*wrong.mean_arcsec))
    assert length_of(wrong.arrow) == pytest.approx(LONGEST * drawn.side, abs=0.2)
    usual = [np.median([length_of(each.arrow) for each in map.cells]) for map in (before, drawn)]
    assert usual[1] > 0.5 * usual[0]


def test_a_wrong_magnitude_is_marked_at_the_edge_of_the_others_range(rng):
    plain = tracker_of(rng)
    observed = plain.observed_mag.copy()
    observed[:2] = 14.0, -3.0
    drawn = magnitude_chart(replace(plain, observed_mag=observed))
    assert drawn.ticks == magnitude_chart(plain).ticks
    assert drawn.beyond_mag == (14.0, -3.0)
    assert drawn.beyond.count("M") == 2
    assert drawn.stars == 4000


# ---- attitude and rate ---------------------------------------------------------------------------


def turning(rate_deg_per_s, count, step_s=10.0):
    """Attitudes of a body that turns at a rate in its own axes: scipy's body-to-inertial."""
    angle = np.outer(np.arange(count) * step_s, rate_deg_per_s)
    return Rotation.random(random_state=1) * Rotation.from_rotvec(angle, degrees=True)


def test_rates_are_those_at_which_the_body_turns_in_its_own_axes():
    rate = np.array([0.02, -0.05, 0.01])
    shown = attitude_charts(attitudes_of(turning(rate, 60)), START, shifted(START, 600.0))
    attitude, rates, sigma = shown
    assert (rates.unit, rates.count) == ("°/s", 59)
    for axis in range(3):
        panel = rates.panels[axis]
        assert (panel.low, panel.high) == pytest.approx((rate[axis],) * 2, abs=1e-9)
        # Two attitudes of one arcsecond each, ten seconds apart.
        assert panel.median_sigma == pytest.approx(np.sqrt(2.0) / 10.0 / 3600.0)
        turned = sorted((0.0, rate[axis] * 590.0))
        assert [attitude.panels[axis].low, attitude.panels[axis].high] == pytest.approx(turned)
        assert sigma.panels[axis].high == pytest.approx(1.0)
    assert sigma.unit == "″"


def test_small_turns_are_in_arcseconds_with_a_band_that_can_be_seen(rng):
    noise = Rotation.from_rotvec(rng.normal(0.0, ARCSEC, (40, 3)))
    shown = attitude_charts(attitudes_of(noise), START, shifted(START, 400.0))
    assert [chart.unit for chart in shown] == ["″", "″/s", "″"]
    assert shown[0].has_band


def test_no_line_and_no_rate_over_a_gap():
    quiet = attitudes_of(turning(np.array([0.0, 0.0, 0.01]), 20))
    later = quiet.time_ns + np.where(np.arange(20) >= 10, 3600 * 10**9, 0)
    shown = attitude_charts(replace(quiet, time_ns=later), START, shifted(START, 4000.0))
    assert shown[0].panels[0].line.count("M") == 2
    assert shown[1].count == 18
    # Batches that were left out of the sample lie between.
    alone = replace(quiet, follows=np.zeros(20, dtype=bool))
    charts = attitude_charts(alone, START, shifted(START, 200.0))
    assert [chart.id for chart in charts] == ["attitude", "sigma"]
    assert charts[0].panels[0].dots.count("M") == 20


def test_a_suspect_attitude_far_from_the_others_is_marked_at_the_edge():
    quiet = attitudes_of(turning(np.array([0.0, 0.0, 0.001]), 20))
    far = quiet.quaternion.copy()
    far[5] = quaternion_from_matrix(Rotation.random(random_state=2).as_matrix())
    status = tuple("suspect" if k == 5 else "good" for k in range(20))
    wrong = replace(quiet, quaternion=far, status=status)
    for chart, plain in zip(
        attitude_charts(wrong, START, shifted(START, 200.0)),
        attitude_charts(quiet, START, shifted(START, 200.0)),
        strict=True,
    ):
        for panel, before in zip(chart.panels, plain.panels, strict=True):
            assert panel.high == pytest.approx(before.high, rel=0.1, abs=1e-9)
            assert (panel.farthest is not None) == (chart.id != "sigma")
            assert panel.suspect.count("M") == (2 if chart.id == "rate" else 1)
