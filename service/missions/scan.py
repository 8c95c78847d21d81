"""Scanning trackers and sun trackers: how times, counts and signals stand for angles.

A scanning tracker is of three kinds, after the report on star images: samples along a line
through each star (`cross`, 7.2 to 7.5), the times at which a star crosses wires (`sweep`), and
the sums of the lines of a raster (`raster`, 7.8).  The angles are those of a batch's `h_deg` and
`v_deg`, as measured: the tracker's calibration applies to them.  A sun tracker has two pairs of
detectors on the tails of the sun's cross (5.3).
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
"""Largest angle from the boresight: a direction is computed from its tangent."""


def _odd(samples: int) -> int:
    if samples % 2 == 0:
        raise ValueError("must be odd: a middle sample with as many on either side")
    return samples


def _rising(wires: tuple[float, ...]) -> tuple[float, ...]:
    if wires[0] != 0.0 or any(b <= a for a, b in pairwise(wires)):
        raise ValueError("must begin with 0 and rise: how far each wire follows the first")
    return wires


class _Detector(Strict):
    """The noise of what is counted, and what the calibration leaves in a place."""

    noise_counts: float = Field(gt=0, le=1e9)
    """One standard deviation of a sample, of a raster: of the sum of a line, without light."""
    background_counts: float = Field(default=0.0, ge=0, le=1e9)
    """Taken off each sample or line."""
    gain_e_per_count: float | None = Field(default=None, gt=0, le=1e6)
    """Adds the noise of the photons; None: `noise_counts` has all of it."""
    saturation_counts: float | None = Field(default=None, gt=0, le=1e12)
    """A sample at or above this is full."""
    sigma_floor_arcsec: float = Field(default=0.0, ge=0, le=3600)
    """What the calibration leaves in a place, per axis, however bright the star."""


class CrossScan(_Detector):
    """Two lines through where each star should stand: samples along h, and along v."""

    kind: Literal["cross"]
    samples: Annotated[int, Field(ge=3, le=MOST_SAMPLES), AfterValidator(_odd)]
    """Samples of a line; the middle one is at the star's `h_deg`, `v_deg`."""
    step_arcsec: float = Field(gt=0, le=3600)
    """From one sample to the next (T of the report)."""


class Sweep(Strict):
    """A sweep along h and one along v, at a constant rate; a star crosses each wire once.

    At t seconds after a sweep began, its first wire is at `start_deg` + `rate_deg_per_s` t.
    """

    kind: Literal["sweep"]
    start_deg: float = Field(gt=-89, lt=89)
    rate_deg_per_s: float = Field(gt=0, le=3600)
    duration_s: float = Field(gt=0, le=3600)
    """Duration of one sweep; a later time is outside of the scan."""
    time_unit_s: float = Field(default=1.0, gt=0, le=3600)
    """Unit of the times in a batch: seconds for each unit of the tracker's clock."""
    time_sigma_s: float = Field(gt=0, le=3600)
    """One standard deviation of the time of one crossing."""
    wires_deg: Annotated[
        tuple[float, ...], Field(min_length=1, max_length=MOST_WIRES), AfterValidator(_rising)
    ] = (0.0,)
    """How far each wire follows the first one; the first is 0."""
    v_after_s: float = Field(default=0.0, ge=0, le=3600)
    """From the beginning of the sweep along h to that of the one along v."""
    sigma_floor_arcsec: float = Field(default=0.0, ge=0, le=3600)
    """What the calibration leaves in a place, per axis."""

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
        """Angle of the first wire when a sweep ends."""
        return self.start_deg + self.rate_deg_per_s * self.duration_s


class Raster(_Detector):
    """The sums of all lines of a raster, columns and rows, with the boresight in its middle."""

    kind: Literal["raster"]
    columns: int = Field(ge=8, le=MOST_LINES)
    rows: int = Field(ge=8, le=MOST_LINES)
    step_deg: float = Field(gt=0, le=10)
    """From one line to the next: columns along h, rows along v."""
    threshold_sigma: float = Field(default=6.0, ge=3, le=100)
    """A line is a star's if its sum is a maximum so far above the noise."""
    half_width_lines: int = Field(default=4, ge=1, le=100)
    """A star's place is the moment of so many lines on either side of its own."""
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
        """The place of the boresight in lines from the first one."""
        return ((self.columns if axis == "h" else self.rows) - 1) / 2.0


Scan = Annotated[CrossScan | Sweep | Raster, Field(discriminator="kind")]


class SunTracker(Strict):
    """A sun tracker: its direction in the body, and its two signals by the Sun's displacement.

    A pair with the counts I+ and I- gives the signal (I+ - I-) / (I+ + I-); the first pair that
    of the displacement towards the tracker's +X, the second towards +Y.
    """

    x_axis_body: Components
    y_axis_body: Components
    z_axis_body: Components
    """The tracker's axes in body components; +Z is where both signals are zero."""
    slope_per_arcmin: float = Field(gt=0, le=100)
    straight_to_arcmin: float = Field(gt=0, le=600)
    """As far as this the signals are straight; a larger one is refused."""
    background_counts: float = Field(default=0.0, ge=0, le=1e9)
    """Taken off each detector."""
    noise_counts: float = Field(gt=0, le=1e9)
    """One standard deviation of a detector; a pair whose light is below 5 of its sum has no sun."""

    @model_validator(mode="after")
    def _axes_are_right_handed(self) -> Self:
        require_right_handed(self.x_axis_body, self.y_axis_body, self.z_axis_body)
        return self

    @cached_property
    def body_from_tracker(self) -> Matrix:
        """The alignment (3, 3): body components = this @ tracker components."""
        return read_only(np.column_stack([self.x_axis_body, self.y_axis_body, self.z_axis_body]))
