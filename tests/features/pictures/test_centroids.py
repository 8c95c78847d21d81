"""Every centroid method is as good as it says, and says so when it cannot be."""

import numpy as np
import pytest

from service.errors import BadInput
from service.features.pictures.centroids.centroid import METHODS, centroid
from service.features.pictures.centroids.psf import GaussianPsf
from service.features.pictures.centroids.window import Detector, Flag, Window, cutout
from tests.reference.star_windows import draw_stars, draw_window, flux_of_peak

DETECTOR = Detector(gain_e_per_count=2.0, read_noise_e=10.0, saturation_counts=2e7)
BACKGROUND = 30.0
PSF = GaussianPsf(1.0)
RATIOS = (10.0, 30.0, 100.0, 1000.0)
STARS = 100
RECURSIVE = pytest.param("recursive", marks=pytest.mark.slow)
"""Where many stars are drawn: that it gives what the matched filter gives is tested of a few."""


def records(rng, method, peak_snr, psf=PSF, number=STARS, **asked):
    """Errors (n, 2), predicted sigmas (n, 2) and the records themselves, of usable ones."""
    drawn = list(draw_stars(rng, number, psf, peak_snr, DETECTOR, BACKGROUND))
    pairs = [(centroid(star.window, method, psf, **asked), star) for star in drawn]
    pairs = [(record, star) for record, star in pairs if record.usable]
    # Of thousands in the noise one may say that it is of no use.
    assert len(pairs) >= 0.97 * number
    errors = [(r.u_px - s.u_px, r.v_px - s.v_px) for r, s in pairs]
    found = [record for record, _ in pairs]
    return np.array(errors), np.array([(r.sigma_u_px, r.sigma_v_px) for r in found]), found


def crlb_px(psf, peak_snr):
    """The Cramer-Rao bound of u by the Fisher information, written out: all light, a fine grid."""
    flux = flux_of_peak(psf, peak_snr, DETECTOR, BACKGROUND)
    grid = np.arange(-12.0, 13.0)
    image = psf.pixel(grid[None, :], grid[:, None])
    step = 1e-4
    slope = (
        psf.pixel(grid[None, :] - step, grid[:, None])
        - psf.pixel(grid[None, :] + step, grid[:, None])
    ) / (2 * step)
    gain = DETECTOR.gain_e_per_count
    variance = (DETECTOR.read_noise_e / gain) ** 2 + (BACKGROUND + flux * image) / gain
    return 1.0 / np.sqrt(np.sum((flux * slope) ** 2 / variance))


@pytest.mark.parametrize("method", ["window", "scan", "matched", RECURSIVE])
def test_scatter_is_within_a_tenth_of_the_predicted_sigma(method, rng):
    """Errors over predicted sigmas, pooled over peak signal-to-noise 10 to 1,000."""
    normal = []
    for peak_snr in RATIOS:
        errors, sigmas, _ = records(rng, method, peak_snr)
        normal.append(errors / sigmas)
    scatter = np.concatenate(normal).std()
    assert scatter == pytest.approx(1.0, abs=0.10)


@pytest.mark.parametrize("method", ["matched", RECURSIVE])
@pytest.mark.parametrize("peak_snr", [10.0, 300.0])
def test_a_fitted_place_is_unbiased_and_reaches_the_cramer_rao_bound(method, peak_snr, rng):
    """Bias below 0.01 px, predicted sigma within 15 % of the bound, scatter as well."""
    errors, sigmas, _ = records(rng, method, peak_snr, number=150)
    bound = crlb_px(PSF, peak_snr)
    assert sigmas.mean() == pytest.approx(bound, rel=0.05)
    doubt = 5.0 / np.sqrt(2 * errors.size)
    assert errors.std() == pytest.approx(bound, rel=0.15 + doubt)
    assert np.all(np.abs(errors.mean(axis=0)) < 0.01 + 5.0 * bound / np.sqrt(len(errors)))


def test_a_fitted_place_does_not_depend_on_where_the_search_begins(rng):
    for star in draw_stars(rng, 5, PSF, 100.0, DETECTOR, BACKGROUND):
        found = [
            centroid(star.window, "matched", PSF, start=(star.u_px + du, star.v_px - du))
            for du in (-2.0, 0.0, 1.5)
        ]
        spread = np.ptp([r.u_px for r in found])
        assert spread < 0.05 * found[0].sigma_u_px


def test_recursive_is_matched_one_pixel_at_a_time(rng):
    """Both stand on the same pixels, so that they agree far below the noise."""
    for star in draw_stars(rng, 15, PSF, 50.0, DETECTOR, BACKGROUND):
        one, other = (centroid(star.window, m, PSF) for m in ("matched", "recursive"))
        assert one.u_px == pytest.approx(other.u_px, abs=0.01 * one.sigma_u_px)
        assert one.sigma_u_px == pytest.approx(other.sigma_u_px, rel=1e-3)
        assert one.flux_counts == pytest.approx(other.flux_counts, rel=1e-3)


@pytest.mark.parametrize("method", ["window", "scan"])
def test_a_truncated_moment_is_biased_as_predicted_and_corrected_with_the_psf(method):
    """Without noise: what the PSF predicts is what the plain moment leaves."""
    wide = GaussianPsf(2.5)
    grid = np.arange(41.0)
    counts = 1e6 * wide.pixel(grid[None, :] - 20.4, grid[:, None] - 19.7)
    window = Window(counts, Detector(read_noise_e=1.0))
    plain = centroid(window, method, half_width_px=3)
    told = centroid(window, method, wide, half_width_px=3)
    assert told.u_px == pytest.approx(20.4, abs=1e-6)
    assert told.v_px == pytest.approx(19.7, abs=1e-6)
    assert plain.u_px - 20.4 == pytest.approx(told.truncation_u_px, abs=1e-6)
    assert abs(told.truncation_u_px) > 0.1
    # The report's law, d [1 - 2 V <Phi(V)> / E], by the ends of the profile alone.
    assert plain.truncation_u_px == pytest.approx(told.truncation_u_px, rel=0.15)
    assert Flag.TRUNCATED in plain.flags
    assert told.flux_counts == pytest.approx(1e6, rel=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_light_below_the_breakdown_ratio_is_refused_in_words(method, rng):
    window = draw_window(rng, PSF, (10.2, 10.1), 30.0, DETECTOR, BACKGROUND)
    found = centroid(window, method, PSF, start=(10.0, 10.0))
    assert not found.usable
    assert Flag.TOO_FAINT in found.flags
    assert "below 5" in found.refused
    assert np.isnan([found.u_px, found.v_px, found.sigma_u_px]).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_dark_window_is_refused(method):
    window = Window(np.full((15, 15), BACKGROUND), DETECTOR, BACKGROUND)
    assert not centroid(window, method, PSF).usable


@pytest.mark.parametrize("method", METHODS)
def test_a_second_star_is_flagged_where_the_psf_is_known(method, rng):
    grid = np.arange(21.0)
    pair = PSF.pixel(grid[None, :] - 10, grid[:, None] - 10) + 0.3 * PSF.pixel(
        grid[None, :] - 12.5, grid[:, None] - 9
    )
    counts = rng.poisson(BACKGROUND + 1e5 * pair).astype(float)
    found = centroid(Window(counts, Detector(), BACKGROUND), method, PSF, start=(10.0, 10.0))
    assert Flag.BLENDED in found.flags
    alone = draw_window(rng, PSF, (10.0, 10.0), 1e5, Detector(), BACKGROUND)
    assert Flag.BLENDED not in centroid(alone, method, PSF).flags


def saturated_window(rng):
    full = Detector(read_noise_e=10.0, saturation_counts=10_000.0)
    return draw_window(rng, PSF, (10.3, 9.8), 2e5, full, BACKGROUND)


@pytest.mark.parametrize("method", ["window", "scan"])
def test_a_moment_of_full_pixels_is_refused(method, rng):
    found = centroid(saturated_window(rng), method, PSF)
    assert not found.usable
    assert "saturated" in found.refused


@pytest.mark.parametrize("method", ["matched", "recursive"])
def test_a_fit_leaves_full_pixels_out_and_says_so(method, rng):
    found = centroid(saturated_window(rng), method, PSF)
    assert Flag.SATURATED in found.flags
    assert abs(found.u_px - 10.3) < 5 * found.sigma_u_px
    assert abs(found.flux_counts - 2e5) < 5 * found.sigma_flux_counts


def test_a_masked_pixel_refuses_a_moment_and_is_left_out_of_a_fit(rng):
    window = draw_window(rng, PSF, (10.0, 10.0), 1e5, Detector(), BACKGROUND)
    hot = window.counts.copy()
    hot[11, 12] = np.nan
    good = np.isfinite(hot)
    masked = Window(hot, Detector(), BACKGROUND, good=good)
    assert Flag.MASKED in centroid(masked, "window", PSF).flags
    found = centroid(masked, "matched", PSF)
    assert Flag.MASKED in found.flags
    assert abs(found.u_px - 10.0) < 5 * found.sigma_u_px


@pytest.mark.parametrize("method", METHODS)
def test_a_star_at_the_frame_s_edge_is_flagged_and_right(method, rng):
    frame = draw_window(rng, PSF, (2.3, 18.6), 1e6, Detector(), BACKGROUND).counts
    window = cutout(frame, 2, 19, 8, Detector(), BACKGROUND)
    assert window.cut
    found = centroid(window, method, PSF)
    assert Flag.EDGE in found.flags
    assert abs(found.u_px - 2.3) < 5 * found.sigma_u_px
    assert abs(found.v_px - 18.6) < 5 * found.sigma_v_px


def test_places_are_in_pixels_of_the_frame(rng):
    frame = draw_window(rng, PSF, (33.2, 12.7), 1e5, Detector(), BACKGROUND, size_px=50).counts
    window = cutout(frame, 33, 13, 6, Detector(), BACKGROUND)
    for method in METHODS:
        found = centroid(window, method, PSF)
        assert abs(found.u_px - 33.2) < 5 * found.sigma_u_px
        assert abs(found.v_px - 12.7) < 5 * found.sigma_v_px


def test_an_error_of_the_background_widens_the_predicted_sigmas(rng):
    star = next(draw_stars(rng, 1, PSF, 100.0, DETECTOR, BACKGROUND))
    shy = Window(star.window.counts, DETECTOR, BACKGROUND, background_sigma_counts=50.0)
    for method in METHODS:
        sure, unsure = centroid(star.window, method, PSF), centroid(shy, method, PSF)
        assert unsure.sigma_flux_counts > 1.5 * sure.sigma_flux_counts
        assert unsure.sigma_u_px >= sure.sigma_u_px


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        ({"method": "median"}, "method"),
        ({"method": "matched"}, "psf"),
        ({"method": "window", "half_width_px": 0}, "half_width_px"),
        ({"method": "window", "start": (np.nan, 1.0)}, "start"),
    ],
)
def test_arguments_that_make_no_sense_are_refused_by_name(asked, field):
    window = Window(np.ones((9, 9)), Detector())
    with pytest.raises(BadInput, match=field):
        centroid(window, **asked)
