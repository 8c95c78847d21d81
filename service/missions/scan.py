"""Scanning trackers and Sun trackers: the conversion of times, counts and signals to angles.

There are three kinds of scanning tracker, after the report on star images: samples along lines
through each star (`cross`, 7.2 to 7.5), times at which a star crosses wires (`sweep`), and sums of
the lines of a raster (`raster`, 7.8). The angles are a batch's `h_deg` and `v_deg`, as measured:
the tracker's calibration applies to them. A Sun tracker has two pairs of detectors on the tails of
the Sun's diffraction cross (5.3).
"""

from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from service.missions.strict import Components, Strict, require_right_handed
from service.vectors import Matrix, read_only

MOST_SAMPLES, MOST_WIRES, MOST_LINES = 1001, 16, 8192
WIDEST_DEG = 89.0
"""Largest angle from the boresight in degrees, since directions use its tangent."""


def _odd(samples: int) -> int:
    if samples % 2 == 0:
        raise ValueError("must be odd: a middle sample with as many on either side")
    return samples


def _rising(wires: tuple[float, ...]) -> tuple[float, ...]:
    if wires[0] != 0.0 or any(b <= a for a, b in pairwise(wires)):
        raise ValueError("must begin with 0 and rise: how far each wire follows the first")
    return wires


class _Detector(Strict):
    """The noise of a scanning detector's counts, and its calibration error."""

    noise_counts: float = Field(gt=0, le=1e9)
    """One standard deviation, without light, of a sample or of the sum of a raster's line."""
    background_counts: float = Field(default=0.0, ge=0, le=1e9)
    """Background counts, subtracted from each sample or line."""
    gain_e_per_count: float | None = Field(default=None, gt=0, le=1e6)
    """Electrons per count, for photon noise; None if `noise_counts` includes the photon noise."""
    saturation_counts: float | None = Field(default=None, gt=0, le=1e12)
    """Saturation level of a sample, in counts."""
    sigma_floor_arcsec: float = Field(default=0.0, ge=0, le=3600)
    """Calibration error of a position in arcsec, per axis, however bright the star."""


class CrossScan(_Detector):
    """Scan along two lines through the expected place of each star: samples along h and along v."""

    kind: Literal["cross"]
    samples: Annotated[int, Field(ge=3, le=MOST_SAMPLES), AfterValidator(_odd)]
    """Number of samples of a line; the middle one is at the star's `h_deg`, `v_deg`."""
    step_arcsec: float = Field(gt=0, le=3600)
    """Interval between samples in arcsec (T of the report)."""


class Sweep(Strict):
    """A pair of sweeps along h and along v at a constant rate; a star crosses each wire once.

    At t seconds after a sweep began, the first wire is at `start_deg` + `rate_deg_per_s` t.
    """

    kind: Literal["sweep"]
    start_deg: float = Field(gt=-89, lt=89)
    rate_deg_per_s: float = Field(gt=0, le=3600)
    duration_s: float = Field(gt=0, le=3600)
    """Duration of one sweep; a later time is outside of the scan."""
    time_unit_s: float = Field(default=1.0, gt=0, le=3600)
    """Unit of the crossing times in a batch: seconds per unit of the tracker's clock."""
    time_sigma_s: float = Field(gt=0, le=3600)
    """One standard deviation of the time of one crossing, in seconds."""
    wires_deg: Annotated[
        tuple[float, ...], Field(min_length=1, max_length=MOST_WIRES), AfterValidator(_rising)
    ] = (0.0,)
    """Angular distance of each wire behind the first one, whose entry is 0."""
    v_after_s: float = Field(default=0.0, ge=0, le=3600)
    """Seconds from the beginning of the sweep along h to that of the sweep along v."""
    sigma_floor_arcsec: float = Field(default=0.0, ge=0, le=3600)
    """Calibration error of a position in arcsec, per axis."""

    @model_validator(mode="after")
    def _is_before_the_tracker(self) -> Self:
        least_deg = self.start_deg - self.wires_deg[-1]
        if self.end_deg >= WIDEST_DEG or least_deg <= -WIDEST_DEG:
            raise ValueError(
                f"reaches from {least_deg:g} to {self.end_deg:g} deg: start_deg, rate_deg_per_s, "
                f"duration_s and wires_deg must stay within {WIDEST_DEG:g} of the boresight"
            )
        return self

    @property
    def end_deg(self) -> float:
        """Angle of the first wire at the end of a sweep, in degrees."""
        return self.start_deg + self.rate_deg_per_s * self.duration_s


class Raster(_Detector):
    """A raster whose lines are summed along columns and rows, centred on the boresight."""

    kind: Literal["raster"]
    columns: int = Field(ge=8, le=MOST_LINES)
    rows: int = Field(ge=8, le=MOST_LINES)
    step_deg: float = Field(gt=0, le=10)
    """Interval between lines in degrees: columns along h, rows along v."""
    threshold_sigma: float = Field(default=6.0, ge=3, le=100)
    """Least height of a star's maximum in the line sums, in sigmas of noise."""
    half_width_lines: int = Field(default=4, ge=1, le=100)
    """Number of lines on either side of a star's maximum that its centroid uses."""
    zero_point_mag: float | None = Field(default=None, ge=-10, le=40)
    """Instrument magnitude of a star of one count; without it the stars have no magnitudes."""

    @model_validator(mode="after")
    def _is_before_the_tracker(self) -> Self:
        reach_deg = max(self.middle("h"), self.middle("v")) * self.step_deg
        if reach_deg >= WIDEST_DEG:
            raise ValueError(
                f"reaches {reach_deg:g} deg from the boresight: step_deg times half of the columns "
                f"and rows must be less than {WIDEST_DEG:g}"
            )
        return self

    def middle(self, axis: Literal["h", "v"]) -> float:
        """Position of the boresight along an axis of the raster, in lines from the first one."""
        return ((self.columns if axis == "h" else self.rows) - 1) / 2.0


Scan = Annotated[CrossScan | Sweep | Raster, Field(discriminator="kind")]


class SunTracker(Strict):
    """A Sun tracker: alignment with the body, and two signals that measure the Sun's displacement.

    A pair with the counts I+ and I- gives the signal (I+ - I-) / (I+ + I-). The first pair measures
    the displacement towards the tracker's +X, the second towards +Y.
    """

    x_axis_body: Components
    y_axis_body: Components
    z_axis_body: Components
    """The tracker's axes in body components; both signals are zero for the Sun along +Z."""
    slope_per_arcmin: float = Field(gt=0, le=100)
    straight_to_arcmin: float = Field(gt=0, le=600)
    """Largest displacement of the Sun in arcmin with linear signals; larger ones are refused."""
    background_counts: float = Field(default=0.0, ge=0, le=1e9)
    """Background counts, subtracted from each detector."""
    noise_counts: float = Field(gt=0, le=1e9)
    """One standard deviation of a detector's counts; a pair sees the Sun above 5 sigmas."""

    @model_validator(mode="after")
    def _axes_are_right_handed(self) -> Self:
        require_right_handed(self.x_axis_body, self.y_axis_body, self.z_axis_body)
        return self

    @cached_property
    def body_from_tracker(self) -> Matrix:
        """The alignment matrix (3, 3) that turns Sun-tracker components into body components."""
        return read_only(np.column_stack([self.x_axis_body, self.y_axis_body, self.z_axis_body]))
