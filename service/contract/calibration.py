"""Records of tracker calibrations: the one in force, and earlier ones."""

from typing import Annotated

from service.contract.base import Components, Count, Digest, Id, Record, Stamp, doc

Terms = Annotated[
    list[Components],
    doc("Powers of the measured h and v in degrees, and the coefficient, as in mission files."),
]


class FocalPlane(Record, frozen=True, kw_only=True):
    """A tracker's focal-plane calibration, as in mission files."""

    scale: float
    h_terms: Terms
    v_terms: Terms


class TrackerMagnitudes(Record, frozen=True, kw_only=True):
    """A tracker's magnitude calibration, as in mission files."""

    zero_mag: float
    scale: float
    color_mag: float


class TrackerGeometry(Record, frozen=True, kw_only=True):
    """Alignment, focal plane and magnitudes of a tracker, as in mission files."""

    name: str
    x_axis_body: Components
    y_axis_body: Components
    z_axis_body: Components
    calibration: FocalPlane
    magnitudes: Annotated[
        TrackerMagnitudes | None, doc("Null: as the mission file has them (earlier versions).")
    ] = None


class CalibrationAdoption(Record, frozen=True, kw_only=True):
    """Adoption of a calibration, or the return to the mission file: author, time and settings."""

    id: Id
    spacecraft: str
    adopted: Stamp
    who: str
    note: str
    calibration: Annotated[Id | None, doc("Null: back to the mission file.")]
    version: Annotated[Count | None, doc("The version of the calibration.")]
    file: Annotated[Digest, doc("The mission file's own settings at that time.")]
    mission: Annotated[Digest, doc("The settings in force since then.")]
    trackers: list[TrackerGeometry] | None


class CalibrationInForce(Record, frozen=True, kw_only=True):
    """Calibration that new batches of a spacecraft use, with its earlier ones."""

    spacecraft: str
    mission: Annotated[Digest, doc("The settings in force.")]
    calibration: Annotated[Id | None, doc("Null: the mission file holds.")]
    overridden: Annotated[
        bool, doc("True if the mission file was changed after the adoption, so that it holds.")
    ]
    history: Annotated[list[CalibrationAdoption], doc("Newest first.")]
