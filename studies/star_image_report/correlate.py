"""Location by cross-correlation (report, part III, and the experiment of 5.4).

Arrays are (rows, columns), displacements in pixels: u along columns, v along rows, of
the image from where the reference stands.  Correlations are circular: a reference
that falls to nothing before its rim is compared as if it went on for ever.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates, maximum_filter

from service.errors import BadInput, Fault
from service.imaging.centroids.window import Array


@dataclass(frozen=True)
class Location:
    """The place of an image against its reference.

    `peak` is the normalised correlation there, 1 for equal shapes; `peak_ratio` that peak
    over the next one; the sigmas are the Cramér-Rao bound for the noise that was told.
    """

    u_px: float
    v_px: float
    peak: float
    peak_ratio: float
    sigma_u_px: float
    sigma_v_px: float


def peak_offset(samples: Array) -> float:
    """The place of the greatest sample of a circle, from the first, by a parabola through three."""
    at = int(np.argmax(samples))
    n = len(samples)
    before, peak, after = samples[at - 1], samples[at], samples[(at + 1) % n]
    bend = float(before - 2.0 * peak + after)
    fine = 0.5 * float(before - after) / bend if bend < 0.0 else 0.0
    whole = at if at <= n // 2 else at - n
    return whole + fine


def displacement_by_peak(signal: Array, reference: Array) -> float:
    """How far a signal is shifted: where its correlation with the reference is greatest."""
    turned = np.fft.rfft(signal) * np.conj(np.fft.rfft(reference))
    return peak_offset(np.fft.irfft(turned, len(signal)))


def displacement_by_derivative(signal: Array, reference: Array) -> float:
    """The same by the zero of the correlation with the reference's derivative.

    It has a sign on either side, which is what a control loop wants; between samples
    the correlation is the trigonometric polynomial through them.
    """
    n = len(signal)
    turned = np.fft.fft(signal) * np.conj(np.fft.fft(reference))
    frequency = 2.0 * math.pi * np.fft.fftfreq(n)
    place = displacement_by_peak(signal, reference)
    for _ in range(20):
        wave = turned * np.exp(1j * frequency * place)
        slope, bend = (
            float((1j * frequency * wave).sum().real),
            float((-(frequency**2) * wave).sum().real),
        )
        if bend >= 0.0:
            break
        step = -slope / bend
        place += step
        if abs(step) < 1e-10:
            break
    return place


def misaligned(image: Array, k_px: float, h_px: float, turn_rad: float) -> Array:
    """f((x + k) cos t - (y + h) sin t, (x + k) sin t + (y + h) cos t) about the middle pixel.

    One printing of the report has a sine for the last cosine.
    """
    rows, columns = image.shape
    y, x = np.mgrid[: float(rows), : float(columns)]
    x, y = x - columns // 2 + k_px, y - rows // 2 + h_px
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    along_x, along_y = x * cosine - y * sine, x * sine + y * cosine
    places = np.stack([along_y + rows // 2, along_x + columns // 2])
    return np.asarray(map_coordinates(image, places, order=3, mode="constant"))


def overlap(image: Array, reference: Array) -> float:
    """phi: the correlation of two images as they lie, over the geometric mean of their own."""
    norm = math.sqrt(float(np.sum(image**2)) * float(np.sum(reference**2)))
    return float(np.sum(image * reference)) / norm


def search_by_axes(image: Array, reference: Array, rounds: int = 2) -> tuple[float, float]:
    """(u, v) by searching along one axis to a peak, then along the other (Fig. 3-3).

    It works on crosses, whose bars overlap wherever they are; a compact star gives no
    peak to climb until it is nearly aligned.  A second round sharpens the first.
    """
    _same_shape(image, reference)
    in_u, in_v = np.fft.rfft(reference, axis=1), np.fft.rfft(reference, axis=0)
    u = v = 0.0
    for _ in range(rounds):
        u = round(u) + _line_peak(_shifted(image, u, v), in_u, axis=1)
        v = round(v) + _line_peak(_shifted(image, u, v), in_v, axis=0)
    return u, v


def _line_peak(image: Array, reference_transform: npt.NDArray[np.complex128], axis: int) -> float:
    turned = np.fft.rfft(image, axis=axis) * np.conj(reference_transform)
    return peak_offset(np.fft.irfft(turned.sum(axis=1 - axis), image.shape[axis]))


def _shifted(image: Array, u_px: float, v_px: float) -> Array:
    """The image moved back by whole pixels."""
    return np.roll(image, (-round(v_px), -round(u_px)), axis=(0, 1)) if u_px or v_px else image


def locate(image: Array, reference: Array, noise_sigma: float = 0.0) -> Location:
    """The place of the reference in an image of the same shape, to a small part of a pixel.

    The greatest normalised correlation over all whole displacements, then the zero of
    its derivatives.  `noise_sigma` is that of a pixel of the image.
    """
    _same_shape(image, reference)
    rows, columns = image.shape
    plain, pattern = image - image.mean(), reference - reference.mean()
    norm = math.sqrt(float(np.sum(plain**2)) * float(np.sum(pattern**2)))
    if norm == 0.0:
        raise BadInput(Fault("image", "holds nothing to correlate: it is the same everywhere"))
    turned = np.fft.fft2(plain) * np.conj(np.fft.fft2(pattern)) / norm
    surface = np.fft.ifft2(turned).real
    row, column = (int(each) for each in np.unravel_index(np.argmax(surface), surface.shape))
    u = float(column if column <= columns // 2 else column - columns)
    v = float(row if row <= rows // 2 else row - rows)
    u, v, peak = _polished(turned, u, v)
    # As much of the pattern as the image holds, by its best fit.
    scale = peak * norm / float(np.sum(pattern**2))
    sigma_u, sigma_v = _bounds(pattern, scale, noise_sigma)
    return Location(u, v, peak, _peak_ratio(surface, row, column), sigma_u, sigma_v)


def _same_shape(image: Array, reference: Array) -> None:
    if image.shape != reference.shape:
        raise BadInput(
            Fault(
                "reference",
                f"must have the shape of the image, {image.shape}",
                str(reference.shape),
            )
        )


def _polished(turned: npt.NDArray[np.complex128], u: float, v: float) -> tuple[float, float, float]:
    """Newton's steps to where both derivatives of the correlation vanish, and its value there."""
    rows, columns = turned.shape
    fu = 2.0 * math.pi * np.fft.fftfreq(columns)[None, :]
    fv = 2.0 * math.pi * np.fft.fftfreq(rows)[:, None]
    for _ in range(20):
        wave = turned * np.exp(1j * (fu * u + fv * v))
        slope = np.array([(1j * fu * wave).sum().real, (1j * fv * wave).sum().real])
        cross = -(fu * fv * wave).sum().real
        bend = np.array([[-(fu**2 * wave).sum().real, cross], [cross, -(fv**2 * wave).sum().real]])
        if bend[0, 0] >= 0.0 or np.linalg.det(bend) <= 0.0:
            break
        step = np.clip(-np.linalg.solve(bend, slope), -0.5, 0.5)
        u, v = u + float(step[0]), v + float(step[1])
        if np.abs(step).max() < 1e-9:
            break
    value = float((turned * np.exp(1j * (fu * u + fv * v))).sum().real) / turned.size
    return u, v, value


def _peak_ratio(surface: Array, row: int, column: int) -> float:
    """The greatest peak over the next that is a peak of its own; infinite where none is."""
    peaks = (surface == maximum_filter(surface, size=5, mode="wrap")) & (surface > 0.0)
    peaks[row, column] = False
    return float(surface[row, column] / surface[peaks].max()) if peaks.any() else math.inf


def _bounds(pattern: Array, scale: float, noise_sigma: float) -> tuple[float, float]:
    """The bounds of any unbiased method, in white noise, for this many times the pattern."""
    transform = np.fft.fft2(pattern)
    fu = 2j * math.pi * np.fft.fftfreq(pattern.shape[1])[None, :]
    fv = 2j * math.pi * np.fft.fftfreq(pattern.shape[0])[:, None]
    in_u, in_v = np.fft.ifft2(fu * transform).real, np.fft.ifft2(fv * transform).real
    rows = scale * np.stack([in_u.ravel(), in_v.ravel()])
    covariance = noise_sigma**2 * np.linalg.pinv(rows @ rows.T)
    return math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])


def negative(image: Array, full_at: float) -> Array:
    """A film that light darkened: 1 where there was none, 0 from `full_at` of the peak on (5.4)."""
    return np.asarray(1.0 - np.minimum(image / (full_at * float(image.max())), 1.0))


def light_through(image: Array, film: Array, u_px: int, v_px: int) -> float:
    """The share of an image's light that passes a film moved by whole pixels."""
    moved = np.roll(film, (v_px, u_px), axis=(0, 1))
    return float(np.sum(image * moved) / np.sum(image))
