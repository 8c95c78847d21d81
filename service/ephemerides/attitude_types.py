"""Conversion of CCSDS attitude types to quaternions and body rates.

A state transforms from frame A to frame B, one of which is the body.  Euler angles rotate the axes
in the order of their sequence; spin types give the direction of the body's Z axis and the phase
about it.  Types are interpreted as in Orekit.
"""

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.vectors import (
    Vector,
    attitude_matrices,
    from_ra_dec,
    rotate_about,
    turned_quaternion,
)

Attitude = Literal["quaternion", "euler", "spin", "dcm"]
Rates = Literal["none", "q_dot", "euler", "angvel", "spin", "nutation", "momentum"]
SEQUENCES = tuple(
    "".join(axes)
    for axes in itertools.product("XYZ", repeat=3)
    if len(set(axes[:2])) == len(set(axes[1:])) == 2
)
"""Valid Euler sequences: three axes, no two consecutive ones the same."""
_SIZES = {"quaternion": 4, "euler": 3, "spin": 3, "dcm": 9}
_RATE_SIZES = {"none": 0, "q_dot": 4, "euler": 3, "angvel": 3, "spin": 1, "nutation": 4}
_RATE_SIZES["momentum"] = 4
_AXES = np.eye(3)


@dataclass(frozen=True)
class AttitudeType:
    """Representation of a state by type: which attitude values, followed by which rates."""

    attitude: Attitude
    rates: Rates = "none"

    @property
    def size(self) -> int:
        """Number of values in a state of this type."""
        return _SIZES[self.attitude] + _RATE_SIZES[self.rates]

    def names(self, sequence: str) -> list[tuple[str, ...]]:
        """Possible names of the XML elements of a state, in the order of a KVN state.

        Version 2 numbers Euler angles, version 1 names them after the axes of the `sequence`.
        """
        axes = [*enumerate(sequence or "XYZ", 1)]
        attitude: dict[str, list[tuple[str, ...]]] = {
            "quaternion": [("Q1",), ("Q2",), ("Q3",), ("QC",)],
            "euler": [(f"ANGLE_{k}", f"{axis}_ANGLE") for k, axis in axes],
            "spin": [("SPIN_ALPHA",), ("SPIN_DELTA",), ("SPIN_ANGLE",)],
        }
        spin = ("SPIN_ANGLE_VEL",)
        rates: dict[str, list[tuple[str, ...]]] = {
            "none": [],
            "q_dot": [("Q1_DOT",), ("Q2_DOT",), ("Q3_DOT",), ("QC_DOT",)],
            "euler": [(f"ANGLE_{k}_DOT", f"{axis}_RATE") for k, axis in axes],
            "angvel": [(f"ANGVEL_{axis}", f"{axis}_RATE") for axis in "XYZ"],
            "spin": [spin],
            "nutation": [spin, ("NUTATION",), ("NUTATION_PER",), ("NUTATION_PHASE",)],
            "momentum": [spin, ("MOMENTUM_ALPHA",), ("MOMENTUM_DELTA",), ("NUTATION_VEL",)],
        }
        return [*attitude[self.attitude], *rates[self.rates]]


@dataclass(frozen=True)
class Frames:
    """Relation between body and inertial axes in the states of a file.

    `sequence` are the axes of Euler angles.  `from_body` is true if frame A is the body, and
    `is_inverse` if a state transforms from body to inertial.  `rate_in_body`: angular velocities
    have components about the body's axes, otherwise about inertial ones.
    """

    sequence: str = ""
    from_body: bool = False
    is_inverse: bool = False
    rate_in_body: bool = True


def body_attitudes(
    type: AttitudeType, numbers: Vector, frames: Frames
) -> tuple[Vector, Vector | None]:
    """Attitudes (n, 4), inertial to body, and rates (n, 3) from states (n, `type.size`).

    Quaternions of states have the scalar last.  Rates are of the body relative to inertial in body
    axes, rad/s; None if the type has none.
    """
    size = _SIZES[type.attitude]
    given, more = numbers[:, :size], numbers[:, size:]
    q = _TRANSFORMS[type.attitude](given, frames.sequence)
    body = q * [-1.0, -1.0, -1.0, 1.0] if frames.is_inverse else q
    if type.rates == "none":
        return body, None
    if type.rates == "angvel":
        rate = np.radians(more) * (-1.0 if frames.from_body else 1.0)
        return body, rate if frames.rate_in_body else _components(body, rate)
    rate = _rates(type, q, more, given, frames.sequence)
    # The rate of A relative to B, about A's axes, is minus the rate of B relative to A.
    return body, -_components(body, rate) if frames.is_inverse else rate


def _components(q: Vector, vectors: Vector) -> Vector:
    """Components (n, 3) of vectors in the frames that quaternions (n, 4) turn into."""
    return np.asarray(np.einsum("nij,nj->ni", attitude_matrices(q), vectors))


def _unit(q: Vector) -> Vector:
    return np.asarray(q / np.linalg.norm(q, axis=1)[:, None])


def _of_quaternion(given: Vector, sequence: str) -> Vector:
    return _unit(given)


def _of_euler(given: Vector, sequence: str) -> Vector:
    q = np.tile([0.0, 0.0, 0.0, 1.0], (len(given), 1))
    for angle, axis in zip(np.radians(given).T, sequence, strict=True):
        q = turned_quaternion(q, angle[:, None] * _AXES["XYZ".index(axis)])
    return _unit(q)


def _of_spin(given: Vector, sequence: str) -> Vector:
    alpha, delta, angle = given.T
    return _of_euler(np.column_stack([90.0 + alpha, 90.0 - delta, angle]), "ZXZ")


def _of_matrix(given: Vector, sequence: str) -> Vector:
    from scipy.spatial.transform import Rotation

    # scipy's matrices rotate vectors, those of a message rotate the axes.
    matrices = given.reshape(-1, 3, 3).transpose(0, 2, 1)
    return np.asarray(Rotation.from_matrix(matrices).as_quat())


_TRANSFORMS = {
    "quaternion": _of_quaternion,
    "euler": _of_euler,
    "spin": _of_spin,
    "dcm": _of_matrix,
}


def _rates(type: AttitudeType, q: Vector, more: Vector, given: Vector, sequence: str) -> Vector:
    """Angular velocity (n, 3) of frame B relative to A, about the axes of B, in rad/s."""
    if type.rates == "q_dot":
        norm = np.linalg.norm(given, axis=1)[:, None]
        return _of_derivative(q, more / norm)
    if type.rates == "euler":
        angles = given if type.attitude == "euler" else _euler_angles(q, sequence)
        return _of_euler_rates(np.radians(angles), np.radians(more), sequence)
    rate = np.radians(more[:, :1]) * _AXES[2]
    if type.rates == "nutation":
        nutation, phase = np.radians(more[:, [1, 3]]).T
        momentum = np.column_stack(
            [
                np.sin(nutation) * np.cos(phase),
                -np.sin(nutation) * np.sin(phase),
                np.cos(nutation),
            ]
        )
        rate = rate + 2.0 * np.pi / more[:, 2:3] * momentum
    if type.rates == "momentum":
        momentum = _components(q, from_ra_dec(more[:, 1], more[:, 2]))
        rate = rate + np.radians(more[:, 3:]) * momentum
    return np.asarray(rate)


def _of_derivative(q: Vector, derivative: Vector) -> Vector:
    v, c = q[:, :3], q[:, 3:]
    part, scalar = derivative[:, :3], derivative[:, 3:]
    return np.asarray(2.0 * (c * part - scalar * v + np.cross(part, v)))


def _euler_angles(q: Vector, sequence: str) -> Vector:
    from scipy.spatial.transform import Rotation

    # Turns about axes of the body, of which scipy's capital letters tell.
    return np.asarray(Rotation.from_quat(q).as_euler(sequence, degrees=True))


def _of_euler_rates(angles_rad: Vector, rates_rad_s: Vector, sequence: str) -> Vector:
    """Angular velocity from Euler angle rates: each about its axis, rotated by later angles."""
    total = np.zeros_like(rates_rad_s)
    for place, letter in enumerate(sequence):
        axis = _AXES["XYZ".index(letter)]
        total = rotate_about(-angles_rad[:, place : place + 1] * axis, total)
        total = total + rates_rad_s[:, place : place + 1] * axis
    return np.asarray(total)
