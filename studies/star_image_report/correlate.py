"""Location of star images by cross-correlation (report, part III, and experiment 5.4).

Arrays are (rows, columns), displacements in pixels: u along columns, v along rows, of the image
from the reference.  Correlations are circular: a reference that falls to nothing before its edge is
treated as periodic.

Also correlation with rotation: phi(k, h, theta) of 3.2, and the three unknowns found from it.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates, maximum_filter

from service.errors import BadInput, Fault
from service.features.pictures.centroids.window import Array
from studies.star_image_report.claims import Claim, Picture, Study


@dataclass(frozen=True)
class Location:
    """Displacement of an image from its reference, with sigmas.

    `peak` is the normalised correlation, 1 for equal shapes; `peak_ratio` is that peak over the
    next one; the sigmas are the Cramér-Rao bound for the given noise.
    """

    u_px: float
    v_px: float
    peak: float
    peak_ratio: float
    sigma_u_px: float
    sigma_v_px: float


def peak_offset(samples: Array) -> float:
    """Position of the maximum of periodic samples, from the first, by a parabola through three."""
    at = int(np.argmax(samples))
    n = len(samples)
    before, peak, after = samples[at - 1], samples[at], samples[(at + 1) % n]
    bend = float(before - 2.0 * peak + after)
    fine = 0.5 * float(before - after) / bend if bend < 0.0 else 0.0
    whole = at if at <= n // 2 else at - n
    return whole + fine


def displacement_by_peak(signal: Array, reference: Array) -> float:
    """Shift of a signal in samples, at the maximum of its correlation with the reference."""
    turned = np.fft.rfft(signal) * np.conj(np.fft.rfft(reference))
    return peak_offset(np.fft.irfft(turned, len(signal)))


def displacement_by_derivative(signal: Array, reference: Array) -> float:
    """Shift of a signal, at the zero of its correlation with the reference's derivative.

    The correlation changes sign there, as a control loop needs; between samples it is the
    trigonometric polynomial through them.
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
    """Shifted and rotated image f((x + k) cos t - (y + h) sin t, (x + k) sin t + (y + h) cos t).

    Coordinates count from the middle pixel.  One printing of the report has a sine for the last
    cosine.
    """
    rows, columns = image.shape
    y, x = np.mgrid[: float(rows), : float(columns)]
    x, y = x - columns // 2 + k_px, y - rows // 2 + h_px
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    along_x, along_y = x * cosine - y * sine, x * sine + y * cosine
    places = np.stack([along_y + rows // 2, along_x + columns // 2])
    return np.asarray(map_coordinates(image, places, order=3, mode="constant"))


def overlap(image: Array, reference: Array) -> float:
    """Correlation phi of two images as they are, normalised by the root of their energies."""
    norm = math.sqrt(float(np.sum(image**2)) * float(np.sum(reference**2)))
    return float(np.sum(image * reference)) / norm


def search_by_axes(image: Array, reference: Array, rounds: int = 2) -> tuple[float, float]:
    """Displacement (u, v) of an image by a search for a peak along one axis, then the other.

    The search works on crosses, whose bars always overlap; a compact star gives no peak until
    nearly aligned.  A second round improves the first (Fig. 3-3).
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
    """Image shifted back by whole pixels."""
    return np.roll(image, (-round(v_px), -round(u_px)), axis=(0, 1)) if u_px or v_px else image


def locate(image: Array, reference: Array, noise_sigma: float = 0.0) -> Location:
    """Displacement of an image from a reference of the same shape, to a small part of a pixel.

    The maximum of the normalised correlation over all whole displacements, then the zero of its
    derivatives.  `noise_sigma` is that of a pixel of the image.
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
    """Place (u, v) of the correlation's peak by Newton's method, and the correlation there."""
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
    """Ratio of the highest peak to the next separate one; infinite without another."""
    peaks = (surface == maximum_filter(surface, size=5, mode="wrap")) & (surface > 0.0)
    peaks[row, column] = False
    return float(surface[row, column] / surface[peaks].max()) if peaks.any() else math.inf


def _bounds(pattern: Array, scale: float, noise_sigma: float) -> tuple[float, float]:
    """Cramér-Rao bounds of a displacement in white noise, for a pattern times `scale`."""
    transform = np.fft.fft2(pattern)
    fu = 2j * math.pi * np.fft.fftfreq(pattern.shape[1])[None, :]
    fv = 2j * math.pi * np.fft.fftfreq(pattern.shape[0])[:, None]
    in_u, in_v = np.fft.ifft2(fu * transform).real, np.fft.ifft2(fv * transform).real
    rows = scale * np.stack([in_u.ravel(), in_v.ravel()])
    covariance = noise_sigma**2 * np.linalg.pinv(rows @ rows.T)
    return math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])


def negative(image: Array, full_at: float) -> Array:
    """Film exposed by an image: 1 without light, 0 from a fraction `full_at` of the peak (5.4)."""
    return np.asarray(1.0 - np.minimum(image / (full_at * float(image.max())), 1.0))


def light_through(image: Array, film: Array, u_px: int, v_px: int) -> float:
    """Share of an image's light that passes a film shifted by whole pixels."""
    moved = np.roll(film, (v_px, u_px), axis=(0, 1))
    return float(np.sum(image * moved) / np.sum(image))


HALF_PX = 40
SIGMA_PX = 2.0
FIELD = ((-22.0, -9.0, 1.0), (17.0, -19.0, 0.8), (5.0, 21.0, 0.6), (-12.0, 16.0, 0.9))
"""Stars of a test field: x and y from the middle in px, and brightness."""
TURN_STEP_RAD = 0.07
"""Step of trial rotations: after half of it, 0.9 px at the farthest star, images overlap."""
ROUNDS = 12
DIFFERENCE = 1e-3


@dataclass(frozen=True)
class Alignment:
    """Misalignment of an image: k and h in px, rotation in rad, and the sigma of each."""

    k_px: float
    h_px: float
    turn_rad: float
    sigmas: tuple[float, float, float]


def field_image(stars: tuple[tuple[float, float, float], ...] = FIELD) -> Array:
    """Image of Gaussian stars on 2 HALF + 1 pixels each way."""
    place = np.arange(-HALF_PX, HALF_PX + 1.0)
    image = np.zeros((len(place), len(place)))
    for x, y, light in stars:
        square = (place[None, :] - x) ** 2 + (place[:, None] - y) ** 2
        image += light * np.exp(-0.5 * square / SIGMA_PX**2)
    return image


def correlation_of_field(
    k_px: float, h_px: float, turn_rad: float, stars: tuple[tuple[float, float, float], ...] = FIELD
) -> float:
    """Correlation phi(k, h, theta) of Gaussian stars over phi(0, 0, 0), in closed form.

    The misaligned image of a round star is that star at R^T r - (k, h); the product of two
    Gaussians at a distance d integrates to exp(-d² / 4 sigma²), up to a constant.
    """
    place = np.array([(x, y) for x, y, _ in stars])
    light = np.array([each[2] for each in stars])
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    turned = place @ np.array([[cosine, -sine], [sine, cosine]]) - (k_px, h_px)

    def summed(other: Array) -> float:
        square = ((place[:, None, :] - other[None, :, :]) ** 2).sum(axis=2)
        return float(light @ np.exp(-0.25 * square / SIGMA_PX**2) @ light)

    return summed(turned) / summed(place)


def align(image: Array, reference: Array, noise_sigma: float) -> Alignment:
    """Find the misalignment of an image with any rotation: the maximum of phi(k, h, theta).

    For each of many rotations all displacements are tried by a Fourier transform, followed by least
    squares.
    """
    best, start = -math.inf, (0.0, 0.0, 0.0)
    transform = np.fft.rfft2(image)
    for turn in np.arange(-math.pi, math.pi, TURN_STEP_RAD):
        turned = misaligned(reference, 0.0, 0.0, float(turn))
        surface = np.fft.irfft2(transform * np.conj(np.fft.rfft2(turned)), image.shape)
        at = int(np.argmax(surface))
        if surface.flat[at] > best:
            best = float(surface.flat[at])
            v, u = (
                float(each if each <= n // 2 else each - n)
                for each, n in zip(divmod(at, image.shape[1]), image.shape, strict=True)
            )
            start = -u, -v, float(turn)
    return refine(image, reference, start, noise_sigma)


def refine(
    image: Array, reference: Array, start: tuple[float, float, float], noise_sigma: float
) -> Alignment:
    """Refine a misalignment by least squares from a start; `sigmas` are the Cramér-Rao bound."""
    state = np.array(start)
    for _ in range(ROUNDS):
        model = misaligned(reference, *state)
        rows = _changes(reference, state)
        step = np.linalg.lstsq(rows, (image - model).ravel(), rcond=None)[0]
        # A pixel of the stars' sigma, or its angle: beyond it the changes are others.
        step *= min(1.0, 1.0 / max(abs(step[0]), abs(step[1]), 20.0 * abs(step[2]), 1e-12))
        state = state + step
        if np.abs(step).max() < 1e-7:
            break
    bound = noise_sigma * np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
    k, h, turn = (float(each) for each in state)
    return Alignment(k, h, turn, (float(bound[0]), float(bound[1]), float(bound[2])))


def _changes(reference: Array, state: Array) -> Array:
    """Derivatives of the image (pixels, 3) by k, h and the rotation."""
    columns = []
    for axis in range(3):
        step = DIFFERENCE * np.eye(3)[axis] * (1.0 if axis < 2 else 0.05)
        ahead, behind = (misaligned(reference, *(state + sign * step)) for sign in (1.0, -1.0))
        columns.append(((ahead - behind) / (2.0 * step[axis])).ravel())
    return np.stack(columns, axis=1)


def claims(study: Study) -> tuple[Claim, ...]:
    """Check the claims of section 3.2 on rotated images."""
    rng = study.rng(31)
    reference = field_image()
    off = 0.0
    for _ in range(20 if study.quick else 200):
        k, h = rng.uniform(-4.0, 4.0, 2)
        turn = float(rng.uniform(-0.3, 0.3))
        measured = overlap(misaligned(reference, k, h, turn), reference)
        off = max(off, abs(measured - correlation_of_field(k, h, turn)))
    same = [_where_half(axis) for axis in range(3)]
    found = _found_anywhere(rng, reference, 3 if study.quick else 30)
    trials = 40 if study.quick else 300
    ratio = _scatter(rng, reference, trials)
    return (
        Claim(
            "3.2",
            "phi(k, h, theta) is greatest where k = h = theta = 0",
            f"of a field of four stars it is its closed form to {off:.0e}, and falls every way",
            "confirmed",
            off < 2e-3 and all(correlation_of_field(*_along(axis, 0.2)) < 1.0 for axis in range(3)),
            {"largest difference": off},
        ),
        Claim(
            "3.2",
            "a value of phi does not define k, h and theta",
            f"phi is a half for k = {same[0]:.3f} px, for h = {same[1]:.3f} px, and for a turn of "
            f"{math.degrees(same[2]):.3f}°, each alone",
            "confirmed",
            all(abs(correlation_of_field(*_along(n, x)) - 0.5) < 1e-9 for n, x in enumerate(same)),
            {"k (px)": same[0], "h (px)": same[1], "turn (rad)": same[2]},
        ),
        Claim(
            "3.2",
            "the search for three unknowns is a difficult problem",
            f"turns in steps of {math.degrees(TURN_STEP_RAD):.0f}°, all displacements of each by a "
            f"transform: {found} fields turned by any angle are found; scatter of k, h, theta over "
            "the Cramér-Rao bound " + ", ".join(f"{x:.3f}" for x in ratio),
            "added",
            found.split(" of ")[0] == found.split(" of ")[1]
            and max(abs(x - 1.0) for x in ratio) < max(0.1, 4.0 / math.sqrt(2.0 * trials)),
            {"scatter over bound": ratio},
        ),
    )


def _along(axis: int, value: float) -> tuple[float, float, float]:
    k, h, turn = (value if axis == n else 0.0 for n in range(3))
    return k, h, turn


def _where_half(axis: int) -> float:
    """Misalignment along one axis at which phi falls to a half, by bisection."""
    low, high = 0.0, (6.0, 6.0, 0.4)[axis]
    for _ in range(60):
        middle = 0.5 * (low + high)
        if correlation_of_field(*_along(axis, middle)) > 0.5:
            low = middle
        else:
            high = middle
    return low


def _found_anywhere(rng: np.random.Generator, reference: Array, trials: int) -> str:
    right = 0
    for _ in range(trials):
        k, h = rng.uniform(-6.0, 6.0, 2)
        turn = float(rng.uniform(-math.pi, math.pi))
        image = misaligned(reference, k, h, turn) + rng.normal(0.0, 0.02, reference.shape)
        at = align(image, reference, 0.02)
        error = math.remainder(at.turn_rad - turn, math.tau)
        right += abs(at.k_px - k) < 0.1 and abs(at.h_px - h) < 0.1 and abs(error) < 0.005
    return f"{right} of {trials}"


def _scatter(rng: np.random.Generator, reference: Array, trials: int) -> list[float]:
    normal = []
    for _ in range(trials):
        truth = (*rng.uniform(-2.0, 2.0, 2), rng.uniform(-0.2, 0.2))
        image = misaligned(reference, *truth) + rng.normal(0.0, 0.02, reference.shape)
        at = refine(image, reference, truth, 0.02)
        errors = np.array([at.k_px, at.h_px, at.turn_rad]) - truth
        normal.append(errors / np.array(at.sigmas))
    return [float(each) for each in np.sqrt((np.array(normal) ** 2).mean(axis=0))]


def pictures() -> dict[str, Picture]:
    """Figures of section 3.2 on rotated images."""
    return {
        "imaging-rotation": Picture(
            "phi of a field of four stars as one of k and theta moves alone; circles: by the "
            "images, lines: in closed form.",
            (6.4, 2.8),
            _draw,
        )
    }


def _draw(figure: Any) -> None:
    axes = figure.subplots(1, 2, sharey=True)
    reference = field_image()
    for axis, number, reach, scale, label in (
        (axes[0], 0, 12.0, 1.0, "k (px)"),
        (axes[1], 2, 0.5, 180.0 / math.pi, "turn (deg)"),
    ):
        fine, coarse = np.linspace(-reach, reach, 201), np.linspace(-reach, reach, 21)
        exact = [correlation_of_field(*_along(number, float(x))) for x in fine]
        axis.plot(scale * fine, exact, color="#0b5394")
        seen = [
            overlap(misaligned(reference, *_along(number, float(x))), reference) for x in coarse
        ]
        axis.plot(scale * coarse, seen, "o", mfc="none", ms=4, color="#b45309")
        axis.set(xlabel=label)
    axes[0].set(ylabel="phi over phi(0, 0, 0)")
