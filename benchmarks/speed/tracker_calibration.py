"""Calibration of two trackers against one dense least squares of numpy for the same rows.

    python -m benchmarks tracker_calibration

The rows are those of the linear problem at the start: two for each star, the attitude of each
batch projected out of them, one column for each unknown.  `numpy.linalg.lstsq` is timed with
these alone; making them is not counted.  The calibration finds its robust weights, its
covariance and what is not observable as well.  Its answer is held against the truth, and
against that of numpy.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from benchmarks.bounds import at_most, between
from benchmarks.report import Report
from service.features.calibration.estimate import Calibration, begun, calibrate
from service.features.calibration.linearise import Model, linearised
from service.features.calibration.stars import IdentifiedStars
from service.missions.mission import Tracker
from service.vectors import ARCSEC_PER_RADIAN

Array = npt.NDArray[np.float64]

BATCHES, QUICK_BATCHES = 10_000, 300
STARS, SIGMA_ARCSEC, RADIUS_DEG = 5, 6.0, 4.0
DEGREE, ROUNDS = 3, 9
MISALIGNED_ARCSEC = np.array([35.0, -22.0, 80.0])
MOST_TIMES = 2.0
MOST_APART_SIGMAS = 1.0
"""Greatest difference in sigmas from numpy; Huber's weights at 96 % efficiency cause 0.2."""


def _tracker(name: str, x: Any, y: Any, z: Any) -> Tracker:
    return Tracker(
        name=name,
        x_axis_body=x,
        y_axis_body=y,
        z_axis_body=z,
        field_of_view_radius_deg=RADIUS_DEG,
        sigma_arcsec=SIGMA_ARCSEC,
        magnitude_sigma_mag=0.1,
    )


X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
TRACKERS = (_tracker("A", Y, Z, X), _tracker("B", Z, X, Y))


def drawn(batches: int, seed: int) -> IdentifiedStars:
    """Stars of two trackers, the second misaligned, with noise according to their sigmas."""
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(batches, rng=rng).as_matrix()
    batch = np.tile(np.repeat(np.arange(batches), STARS), 2)
    tracker = np.repeat([0, 1], batches * STARS)
    radius = np.radians(RADIUS_DEG) * np.sqrt(rng.random(len(batch)))
    around = rng.uniform(0.0, 2.0 * np.pi, len(batch))
    true = _directions(np.column_stack([radius * np.cos(around), radius * np.sin(around)]))
    seen = true + rng.normal(0.0, SIGMA_ARCSEC / ARCSEC_PER_RADIAN, true.shape)
    measured = np.arctan2(seen[:, :2], seen[:, 2:])
    body = np.empty_like(true)
    for index, each in enumerate(TRACKERS):
        own = tracker == index
        body[own] = true[own] @ each.body_from_tracker.T
        turn = MISALIGNED_ARCSEC / ARCSEC_PER_RADIAN * index
        body[own] = Rotation.from_rotvec(turn).apply(body[own])
    return IdentifiedStars(
        trackers=TRACKERS,
        batch=batch,
        tracker=tracker,
        measured_rad=measured,
        angles_rad=measured,
        reference=np.einsum("nji,nj->ni", attitude[batch], body),
        sigma_rad=np.full(len(batch), SIGMA_ARCSEC / ARCSEC_PER_RADIAN),
        time_offset_s=np.zeros(len(batch)),
        temperature_c=np.full(len(batch), np.nan),
        time_s=np.arange(batches, dtype=np.float64),
        attitude=attitude,
        rates_rad_per_s=np.zeros((batches, 3)),
    )


def _directions(angles: Array) -> Array:
    vectors = np.column_stack([np.tan(angles), np.ones(len(angles))])
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def dense_rows(stars: IdentifiedStars, model: Model) -> tuple[Array, Array]:
    """Matrix and right side of the linear problem, with attitudes projected out per batch."""
    fit = begun(stars, model)
    matrix = np.zeros((len(stars), 2, len(fit.unknowns)))
    turned = np.zeros((len(stars), 2, 3))
    for part in fit.parts:
        derivatives = linearised(part, fit.values, fit.attitude)
        matrix[part.rows, :, part.columns] = derivatives.by_unknown.transpose(2, 1, 0)
        turned[part.rows] = derivatives.by_attitude
    order = np.argsort(stars.batch, kind="stable")
    rows = 2 * len(order) // stars.batches
    by_batch = (stars.batches, rows, -1)
    own = turned[order].reshape(by_batch)
    along, _ = np.linalg.qr(own)
    right = -fit.residual.T[order].reshape(by_batch)
    left = matrix[order].reshape(by_batch)
    crossed = np.swapaxes(along, 1, 2)
    left, right = left - along @ (crossed @ left), right - along @ (crossed @ right)
    return left.reshape(stars.batches * rows, -1), right.ravel()


def run(quick: bool, seed: int) -> Report:
    """Benchmark that times both solutions in rotation."""
    batches = QUICK_BATCHES if quick else BATCHES
    model = Model(degree=DEGREE)
    stars = drawn(batches, seed).usable(attitudes_known=False)
    matrix, right = dense_rows(stars, model)
    calibrate_s, dense_s = [], []
    for _ in range(ROUNDS):
        found, seconds = _timed(lambda: calibrate(stars, model))
        calibrate_s.append(seconds)
        solved, seconds = _timed(lambda: np.linalg.lstsq(matrix, right, rcond=None)[0])
        dense_s.append(seconds)
    times = min(calibrate_s) / min(dense_s)
    per_unit = np.array([each.per_unit for each in found.unknowns])
    apart = float(np.sqrt(np.mean(((solved / per_unit - found.value) / found.sigma) ** 2)))
    off = (found.value - _true(found)) / found.sigma
    figures = {
        "batches": batches,
        "stars": len(stars),
        "unknowns": len(found.unknowns),
        "rows of the dense problem": len(matrix),
        "calibrate, s": min(calibrate_s),
        "numpy.linalg.lstsq, s": min(dense_s),
        "times one dense least squares": times,
        "error over claimed sigma, rms": float(np.sqrt(np.mean(off**2))),
        "apart from numpy's answer, sigmas rms": apart,
    }
    bounds = [
        between(
            "error over claimed sigma, rms", figures["error over claimed sigma, rms"], 0.6, 1.4
        ),
        at_most("apart from numpy's answer, sigmas rms", apart, MOST_APART_SIGMAS),
    ]
    if not quick:
        bounds.append(at_most("times one dense least squares", times, MOST_TIMES))
    return Report("tracker calibration", figures, bounds)


def _true(found: Calibration) -> Array:
    return np.array(
        [
            MISALIGNED_ARCSEC["xyz".index(each.term[0])] if each.kind == "alignment" else 0.0
            for each in found.unknowns
        ]
    )


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    begun_s = time.perf_counter()
    found = call()
    return found, time.perf_counter() - begun_s
