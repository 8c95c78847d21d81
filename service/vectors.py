"""Unit vectors, accurate angles, rotations and quaternions.

Every quaternion of the service is `[q1, q2, q3, qc]`: scalar last, qc >= 0, a
coordinate transform from inertial to body axes (CCSDS 504.0-B; Shuster's
A(q)).  A turn of the axes by +30 deg about z is (0, 0, 0.2588, 0.9659).

`matrix_from_quaternion(q) @ r` gives the body components of the inertial
vector `r`.  scipy's `Rotation.from_matrix(A)` and SPICE's `m2q(A)` describe
the conjugate turn; the named converters below are the only bridges to them.
"""

import math
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Projection = Literal["gnomonic", "equidistant", "equisolid", "stereographic"]
"""Name of a lens's projection of the sky: on a plane, or as a fisheye in one of three ways."""

Vector = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]

ARCSEC_PER_RADIAN = math.degrees(1.0) * 3600.0
UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
"""Row and column indices of the stored upper triangle of a symmetric (3, 3) matrix."""


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Mark an array as read-only and return it."""
    # Setting `flags` would take twice as long.
    array.setflags(write=False)
    return array


def locked(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Read-only view of an array, also if the array itself stays writable."""
    return array if not array.flags.writeable else read_only(array.view())


def unit(vectors: npt.ArrayLike) -> Vector:
    """Vectors of shape (..., 3) scaled to length one; a zero vector gives NaN."""
    v = np.asarray(vectors, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(v / np.sqrt(np.sum(v * v, axis=-1, keepdims=True)))


def unit_of(vector: Vector) -> Vector:
    """Scale one vector (3,) to length one, without most of an array's overhead."""
    x, y, z = vector.tolist()
    norm = math.sqrt(x * x + y * y + z * z)
    return vector / (norm or math.nan)


def from_ra_dec(ra_deg: npt.ArrayLike, dec_deg: npt.ArrayLike) -> Vector:
    """Unit vectors (..., 3) from right ascensions and declinations in degrees."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.stack(
        np.broadcast_arrays(np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)),
        axis=-1,
    )


def direction_of(ra_deg: float, dec_deg: float) -> tuple[float, float, float]:
    """Unit vector (x, y, z) from one right ascension and declination in degrees, without arrays."""
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    across = math.cos(dec)
    return across * math.cos(ra), across * math.sin(ra), math.sin(dec)


def to_ra_dec(vectors: npt.ArrayLike) -> tuple[Vector, Vector]:
    """Right ascension in [0, 360) and declination in degrees from vectors (..., 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    ra = np.degrees(np.arctan2(v[..., 1], v[..., 0])) % 360.0
    dec = np.degrees(np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1])))
    return np.where(ra >= 360.0, 0.0, ra), dec


def ra_dec_of(vector: Vector) -> tuple[float, float]:
    """Right ascension and declination in degrees of one unit vector (3,); faster than on arrays."""
    x, y, z = vector.tolist()
    ra_deg = math.degrees(math.atan2(y, x)) % 360.0
    return 0.0 if ra_deg >= 360.0 else ra_deg, math.degrees(math.atan2(z, math.hypot(x, y)))


def angle_between_deg(a: npt.ArrayLike, b: npt.ArrayLike) -> Vector:
    """Angles in degrees between vectors (..., 3), accurate from zero to 180 degrees.

    The form 2 atan2(|a - b|, |a + b|) of unit vectors keeps full precision at
    arcseconds, where an arc cosine has lost half its digits.
    """
    u, v = unit(a), unit(b)
    apart = np.sqrt(np.sum((u - v) ** 2, axis=-1))
    along = np.sqrt(np.sum((u + v) ** 2, axis=-1))
    return np.asarray(np.degrees(2.0 * np.arctan2(apart, along)))


def separation_deg(a: Vector, b: Vector) -> float:
    """Angle in degrees between two unit vectors (3,), without an array's overhead."""
    x, y, z = a.tolist()
    u, v, w = b.tolist()
    apart = math.hypot(x - u, y - v, z - w)
    return math.degrees(2.0 * math.atan2(apart, math.hypot(x + u, y + v, z + w)))


def coordinate_rotation(axis: int, angle_deg: float) -> Matrix:
    """Rotation matrix that turns the axes by `angle_deg` about axis 0, 1 or 2 (x, y, z)."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = s, -s
    return matrix


def rotate_about(rotation_vectors_rad: npt.ArrayLike, vectors: npt.ArrayLike) -> Vector:
    """Rotate vectors (..., 3) about rotation vectors (..., 3) in radians: exp([w x]) v."""
    w = np.asarray(rotation_vectors_rad, dtype=np.float64)
    v = np.asarray(vectors, dtype=np.float64)
    angle = np.sqrt(np.sum(w * w, axis=-1, keepdims=True))
    # sin(x)/x and (1 - cos(x))/x^2 as sinc, which is exact at zero.
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    once = _cross(w, v)
    return np.asarray(v + first * once + second * _cross(w, once))


def _cross(a: Vector, b: Vector) -> Vector:
    # numpy's own cross product spends most of its time on choosing axes.
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def matrix_from_quaternion(quaternion: npt.ArrayLike) -> Matrix:
    """Attitude matrix A(q), (3, 3), of a quaternion (4,): body = A @ inertial."""
    q1, q2, q3, qc = np.asarray(quaternion, dtype=np.float64).tolist()
    return np.array(
        [
            [
                q1 * q1 - q2 * q2 - q3 * q3 + qc * qc,
                2 * (q1 * q2 + q3 * qc),
                2 * (q1 * q3 - q2 * qc),
            ],
            [
                2 * (q1 * q2 - q3 * qc),
                -q1 * q1 + q2 * q2 - q3 * q3 + qc * qc,
                2 * (q2 * q3 + q1 * qc),
            ],
            [
                2 * (q1 * q3 + q2 * qc),
                2 * (q2 * q3 - q1 * qc),
                -q1 * q1 - q2 * q2 + q3 * q3 + qc * qc,
            ],
        ]
    )


def quaternion_from_matrix(matrix: npt.ArrayLike) -> Vector:
    """Quaternion (4,) of one attitude matrix A (3, 3), with qc >= 0.

    Shepperd's choice of the largest component keeps it accurate at every angle, exact half turns
    included.
    """
    a = np.asarray(matrix, dtype=np.float64)
    squares = np.array(
        [
            1 + a[0, 0] - a[1, 1] - a[2, 2],
            1 - a[0, 0] + a[1, 1] - a[2, 2],
            1 - a[0, 0] - a[1, 1] + a[2, 2],
            1 + a[0, 0] + a[1, 1] + a[2, 2],
        ]
    )
    largest = int(np.argmax(squares))
    if largest == 3:
        q = np.array([a[1, 2] - a[2, 1], a[2, 0] - a[0, 2], a[0, 1] - a[1, 0], squares[3]])
    elif largest == 0:
        q = np.array([squares[0], a[0, 1] + a[1, 0], a[0, 2] + a[2, 0], a[1, 2] - a[2, 1]])
    elif largest == 1:
        q = np.array([a[0, 1] + a[1, 0], squares[1], a[1, 2] + a[2, 1], a[2, 0] - a[0, 2]])
    else:
        q = np.array([a[0, 2] + a[2, 0], a[1, 2] + a[2, 1], squares[2], a[0, 1] - a[1, 0]])
    q /= math.sqrt(float(q @ q))
    return -q if q[3] < 0 else q


def attitude_error_arcsec(attitude: npt.ArrayLike, truth: npt.ArrayLike) -> Vector:
    """The small rotation, in arcseconds about the body axes, from the true attitude to another.

    Both are attitude matrices (3, 3).  The vector e satisfies
    A = exp(-[e x]) A_true, so that e^T P^-1 e is chi-square with three degrees
    of freedom when P is the covariance of a solution in body axes.
    """
    q = quaternion_from_matrix(np.asarray(attitude) @ np.asarray(truth).T)
    sine = math.sqrt(float(q[:3] @ q[:3]))
    scale = 2.0 if sine == 0.0 else 2.0 * math.atan2(sine, float(q[3])) / sine
    return np.asarray(q[:3] * scale * ARCSEC_PER_RADIAN)


def rotation_vectors(first: Vector, second: Vector) -> Vector:
    """The rotations (n, 3) of the body from attitudes (n, 4) to others, radians in body axes.

    The vector w satisfies A(second) = exp(-[w x]) A(first); it is the shorter of both turns.
    Accurate at every angle.
    """
    v, c = first[..., :3], first[..., 3:]
    w, d = second[..., :3], second[..., 3:]
    part = c * w - d * v + np.cross(w, v)
    scalar = c * d + np.sum(v * w, axis=-1, keepdims=True)
    part, scalar = np.where(scalar < 0, -part, part), np.abs(scalar)
    sine = np.sqrt(np.sum(part * part, axis=-1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, scalar)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(sine == 0.0, 2.0, angle / sine)
    return np.asarray(part * scale)


def turned_quaternion(quaternion: Vector, rotation_vector_rad: Vector) -> Vector:
    """Attitudes (..., 4) after rotations of the body by vectors (..., 3) in rad, in body axes.

    The inverse of `rotation_vectors`.
    """
    half = 0.5 * np.sqrt(np.sum(rotation_vector_rad**2, axis=-1, keepdims=True))
    p = 0.5 * np.sinc(half / np.pi) * rotation_vector_rad
    s = np.cos(half)
    v, c = quaternion[..., :3], quaternion[..., 3:]
    part = s * v + c * p - np.cross(p, v)
    scalar = s * c - np.sum(p * v, axis=-1, keepdims=True)
    return np.concatenate([part, scalar], axis=-1)


def attitude_matrices(quaternion: Vector) -> Vector:
    """Attitude matrices A(q), (n, 3, 3), of quaternions (n, 4): body = A @ inertial."""
    v, c = quaternion[:, :3], quaternion[:, 3]
    x, y, z = v.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    square = c * c - np.sum(v * v, axis=1)
    return np.asarray(
        square[:, None, None] * np.eye(3)
        + 2.0 * v[:, :, None] * v[:, None, :]
        - 2.0 * c[:, None, None] * cross
    )


def full_matrices(upper: Vector) -> Vector:
    """Symmetric matrices (..., 3, 3) from upper triangles (..., 6) in the order of `UPPER`."""
    full = upper[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    return np.asarray(full.reshape(*upper.shape[:-1], 3, 3))
