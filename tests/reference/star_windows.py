"""Windows of a sensor with a star whose place is known."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from service.features.pictures.centroids.psf import Psf
from service.features.pictures.centroids.window import Detector, Window


@dataclass(frozen=True)
class WindowStar:
    """A noisy window and the truth beside it, in pixels of the window."""

    window: Window
    u_px: float
    v_px: float
    flux_counts: float


def flux_of_peak(psf: Psf, peak_snr: float, detector: Detector, background_counts: float) -> float:
    """The light (counts) whose brightest pixel, star on its centre, has this signal to noise."""
    gain = detector.gain_e_per_count
    floor = float(detector.variance(background_counts))
    # peak / sqrt(floor + peak / gain) = snr
    half = peak_snr**2 / (2.0 * gain)
    peak = half + math.sqrt(half**2 + peak_snr**2 * floor)
    return peak / float(psf.pixel(0.0, 0.0))


def draw_window(
    rng: np.random.Generator,
    psf: Psf,
    place: tuple[float, float],
    flux_counts: float,
    detector: Detector,
    background_counts: float,
    size_px: int = 21,
) -> Window:
    """A square window with one star at (u, v): photon noise, read noise, full well."""
    grid = np.arange(size_px, dtype=np.float64)
    image = psf.pixel(grid[None, :] - place[0], grid[:, None] - place[1])
    electrons = (flux_counts * image + background_counts) * detector.gain_e_per_count
    read = rng.normal(0.0, detector.read_noise_e, image.shape)
    counts = (rng.poisson(np.maximum(electrons, 0.0)) + read) / detector.gain_e_per_count
    counts = np.minimum(counts, detector.saturation_counts)
    return Window(counts, detector, background_counts)


def draw_stars(
    rng: np.random.Generator,
    number: int,
    psf: Psf,
    peak_snr: float,
    detector: Detector,
    background_counts: float,
    size_px: int = 21,
) -> Iterator[WindowStar]:
    """Stars anywhere on the middle pixel of their windows."""
    flux = flux_of_peak(psf, peak_snr, detector, background_counts)
    for _ in range(number):
        u, v = (size_px // 2 + rng.uniform(-0.5, 0.5, 2)).tolist()
        window = draw_window(rng, psf, (u, v), flux, detector, background_counts, size_px)
        yield WindowStar(window, u, v, flux)
