"""The types in which CCSDS messages give attitudes, as quaternions and rates of the body.

A state transforms from frame A to frame B, of which one is the body.  Euler angles turn the axes
one after the other, in the order of their sequence; spin types give the direction of the body's
Z axis and the phase about it.  Read as Orekit reads them.
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
"""Axes of three turns of which no two in a row are about the same."""
_SIZES = {"quaternion": 4, "euler": 3, "spin": 3, "dcm": 9}
_RATE_SIZES = {"none": 0, "q_dot": 4, "euler": 3, "angvel": 3, "spin": 1, "nutation": 4}
_RATE_SIZES["momentum"] = 4
_AXES = np.eye(3)


@dataclass(frozen=True)
class AttitudeType:
    """The numbers of a state: those of the attitude, then those of the rate."""

    attitude: Attitude
    rates: Rates = "none"

    @property
    def size(self) -> int:
        """How many numbers a state has."""
        return _SIZES[self.attitude] + _RATE_SIZES[self.rates]

    def names(self, sequence: str) -> list[tuple[str, ...]]:
        """The elements of an XML state, in the order of the numbers of a text state.

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
    """How states relate the body to inertial axes.

    `sequence` are the axes of Euler angles.  `from_body` is true if frame A is the body, and
    `is_inverse` if a state transforms from body to inertial.  `rate_in_body`: the components of
    an angular velocity are about the body's axes, else about inertial ones.
    """

    sequence: str = ""
    from_body: bool = False
    is_inverse: bool = False
    rate_in_body: bool = True


def body_attitudes(
    type: AttitudeType, numbers: Vector, frames: Frames
) -> tuple[Vector, Vector | None]:
    """The attitudes (n, 4), inertial to body, and rates (n, 3) of states (n, `type.size`).

    The quaternions of states have the scalar last.  Rates are of the body relative to inertial
    in body axes, rad/s; None where the type has none.
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
    # Of A relative to B it is the opposite of that of B relative to A, about the axes of A.
    return body, -_components(body, rate) if frames.is_inverse else rate


def _components(q: Vector, vectors: Vector) -> Vector:
    """The components (n, 3) after the transforms (n, 4) of those before."""
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

    # scipy turns vectors, a matrix of a message the axes.
    matrices = given.reshape(-1, 3, 3).transpose(0, 2, 1)
    return np.asarray(Rotation.from_matrix(matrices).as_quat())


_TRANSFORMS = {
    "quaternion": _of_quaternion,
    "euler": _of_euler,
    "spin": _of_spin,
    "dcm": _of_matrix,
}


def _rates(type: AttitudeType, q: Vector, more: Vector, given: Vector, sequence: str) -> Vector:
    """The angular velocity (n, 3) of frame B relative to A, about the axes of B."""
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
    """Each turn's rate about its axis, carried through the turns that follow."""
    total = np.zeros_like(rates_rad_s)
    for place, letter in enumerate(sequence):
        axis = _AXES["XYZ".index(letter)]
        total = rotate_about(-angles_rad[:, place : place + 1] * axis, total)
        total = total + rates_rad_s[:, place : place + 1] * axis
    return np.asarray(total)
