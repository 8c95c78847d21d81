"""Identified stars of two trackers with known misalignment, distortion, clock and noise.

Drawn with scipy's rotations and numpy's Legendre series, apart from the estimator's own.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legval2d
from scipy.spatial.transform import Rotation

from service.features.calibration.linearise import Model
from service.features.calibration.stars import IdentifiedStars
from service.missions.mission import Tracker

ARCSEC = np.pi / 180.0 / 3600.0
RADIUS_DEG = 4.0


def tracker(name, axes):
    x, y, z = axes
    return Tracker(
        name=name,
        x_axis_body=x,
        y_axis_body=y,
        z_axis_body=z,
        field_of_view_radius_deg=RADIUS_DEG,
        sigma_arcsec=6.0,
        magnitude_sigma_mag=0.1,
    )


TRACKERS = (
    tracker("A", ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))),
    tracker("B", ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
)
MISALIGNED = np.array([35.0, -22.0, 80.0])


@dataclass(frozen=True)
class Truth:
    """What is wrong with tracker B, and how both bend angles.

    `bent` (2 trackers, 2 angles, n, n) are coefficients in arcsec of P_i(x) P_j(y);
    `scale` those of the angles themselves.  `drift` is arcsec of B's alignment per deg C.
    """

    misaligned_arcsec: np.ndarray
    bent: np.ndarray
    scale: tuple = (0.0, 0.0)
    time_tag_s: float = 0.0
    drift: np.ndarray | None = None


def legendre_terms(degree):
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def bending(rng, degree=3, rms_arcsec=10.0, trackers=2):
    """Coefficients without constants, rotation and scale, of so many arcsec rms over the field."""
    bent = np.zeros((trackers, 2, degree + 1, degree + 1))
    if degree == 0:
        return bent
    for i, j in legendre_terms(degree):
        if i + j > 0:
            bent[:, :, i, j] = rng.normal(size=(trackers, 2))
    # The linear terms keep only stretch (h by x, v by -y) and skew (h by y, v by x).
    bent[:, 1, 0, 1] = -bent[:, 0, 1, 0]
    bent[:, 1, 1, 0] = bent[:, 0, 0, 1]
    x, y = field(rng, 20_000).T / RADIUS_DEG
    for each in bent:
        each *= rms_arcsec / np.sqrt(np.mean([legval2d(x, y, one) ** 2 for one in each]))
    return bent


def field(rng, count):
    """Angles (count, 2) in degrees spread evenly over the field of view."""
    radius = RADIUS_DEG * np.sqrt(rng.random(count))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def true_angles(truth, index, measured_deg):
    """What a tracker should have measured, in degrees."""
    x, y = measured_deg.T / RADIUS_DEG
    bent = np.column_stack([legval2d(x, y, each) for each in truth.bent[index]]) / 3600.0
    return measured_deg * (1.0 + truth.scale[index]) + bent


def direction_of(angles_deg):
    tangents = np.tan(np.radians(angles_deg))
    vectors = np.column_stack([tangents, np.ones(len(tangents))])
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def drawn(
    rng,
    batches,
    truth,
    *,
    stars=5,
    sigma_arcsec=6.0,
    told_sigma_arcsec=6.0,
    wrong=0.0,
    rates_deg_per_s=None,
    start_off_arcsec=30.0,
    trackers=TRACKERS,
):
    """The stars of a stretch; `wrong` is the share that has another star's direction."""
    time_s = 60.0 * np.arange(batches)
    attitude = Rotation.random(batches, rng=rng).as_matrix()
    rates = np.zeros((batches, 3)) if rates_deg_per_s is None else np.radians(rates_deg_per_s)
    temperature = 15.0 + 8.0 * np.sin(2.0 * np.pi * np.arange(batches) / max(batches / 3.0, 1.0))
    columns = {name: [] for name in ("batch", "tracker", "measured", "reference", "dt", "temp")}
    for index, each in enumerate(trackers):
        batch = np.repeat(np.arange(batches), stars)
        n = len(batch)
        clean = field(rng, n)
        turn = np.zeros((n, 3))
        if index == 1:
            turn += truth.misaligned_arcsec * ARCSEC
            if truth.drift is not None:
                shift = truth.drift * ARCSEC
                turn += shift * (temperature - temperature.mean())[batch][:, None]
        body = direction_of(true_angles(truth, index, clean)) @ each.body_from_tracker.T
        body = Rotation.from_rotvec(turn).apply(body)
        dt = rng.uniform(-0.5, 0.5, n)
        late = dt + (truth.time_tag_s if index == 1 else 0.0)
        at_epoch = Rotation.from_rotvec(rates[batch] * late[:, None]).apply(body)
        reference = np.einsum("nji,nj->ni", attitude[batch], at_epoch)
        shaken = direction_of(clean)
        shaken = shaken + rng.normal(0.0, sigma_arcsec * ARCSEC, (n, 3))
        measured = np.degrees(np.arctan2(shaken[:, :2], shaken[:, 2:]))
        bad = rng.random(n) < wrong
        off = rng.normal(0.0, 60.0 * ARCSEC, (n, 3)) * bad[:, None]
        reference = reference + off
        reference /= np.linalg.norm(reference, axis=1, keepdims=True)
        columns["batch"].append(batch)
        columns["tracker"].append(np.full(n, index))
        columns["measured"].append(np.radians(measured))
        columns["reference"].append(reference)
        columns["dt"].append(dt)
        columns["temp"].append(temperature[batch])
    joined = {name: np.concatenate(each) for name, each in columns.items()}
    off = Rotation.from_rotvec(rng.normal(0.0, start_off_arcsec * ARCSEC, (batches, 3)))
    return IdentifiedStars(
        trackers=tuple(trackers),
        batch=joined["batch"],
        tracker=joined["tracker"],
        measured_rad=joined["measured"],
        angles_rad=joined["measured"],
        reference=joined["reference"],
        sigma_rad=np.full(len(joined["batch"]), told_sigma_arcsec * ARCSEC),
        time_offset_s=joined["dt"],
        temperature_c=joined["temp"],
        time_s=time_s,
        attitude=off.as_matrix() @ attitude,
        rates_rad_per_s=rates,
    )


def varied(rng, batches):
    """Body rates (batches, 3) in deg/s that differ from batch to batch."""
    return rng.normal(0.0, 0.05, (batches, 3))


def everything(rng, batches, **more):
    """A stretch with all that a model may hold, and that model."""
    truth = Truth(
        MISALIGNED,
        bending(rng),
        scale=(2e-4, -1e-4),
        time_tag_s=0.05,
        drift=np.array([1.5, -0.7, 2.0]),
    )
    stars = drawn(rng, batches, truth, rates_deg_per_s=varied(rng, batches), **more)
    middle = float(stars.temperature_c.mean())
    return truth, stars, Model(degree=3, reference_temperature_c=middle, time_tag=True)


def truth_of(truth, unknowns):
    """The true values of unknowns, in their units."""
    return np.array([_true_value(truth, each) for each in unknowns])


def _true_value(truth, unknown):
    kind, i, j = unknown.term
    index = unknown.tracker
    if unknown.of is not None:
        drifts = unknown.of == "alignment" and index == 1 and truth.drift is not None
        return truth.drift["xyz".index(kind)] if drifts else 0.0
    if unknown.kind == "alignment":
        return truth.misaligned_arcsec["xyz".index(kind)] if index == 1 else 0.0
    if unknown.kind == "scale":
        return truth.scale[index]
    if unknown.kind == "time_tag":
        return truth.time_tag_s
    angle = 0 if kind in ("stretch", "skew", "h") else 1
    return truth.bent[index, angle, i, j]


def error_rms_arcsec(calibration, truth, rng, index):
    """Root mean square of what a tracker's distortion is off by, per angle over the field."""
    x, y = field(rng, 20_000).T / RADIUS_DEG
    off = np.zeros((2, 4, 4))
    errors = calibration.value - truth_of(truth, calibration.unknowns)
    for unknown, error in zip(calibration.unknowns, errors, strict=True):
        kind, i, j = unknown.term
        if unknown.tracker != index or unknown.kind != "distortion":
            continue
        if kind == "stretch":
            off[0, 1, 0], off[1, 0, 1] = error, -error
        elif kind == "skew":
            off[0, 0, 1], off[1, 1, 0] = error, error
        else:
            off["hv".index(kind), i, j] = error
    return float(np.sqrt(np.mean([legval2d(x, y, each) ** 2 for each in off])))
