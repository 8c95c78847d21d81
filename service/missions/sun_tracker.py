"""A sun tracker: two pairs of detectors on the tails of the sun's cross (star images, 5.3)."""

from functools import cached_property
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from service.missions.strict import Components, Strict
from service.vectors import Matrix, read_only


class SunTracker(Strict):
    """Where it looks in the body, and how its two signals grow with the sun's displacement.

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
        axes = self.body_from_tracker
        if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-4) or np.linalg.det(axes) < 0:
            raise ValueError("the three axes must be a right-handed set of unit vectors")
        return self

    @cached_property
    def body_from_tracker(self) -> Matrix:
        """The alignment (3, 3): body components = this @ tracker components."""
        return read_only(np.column_stack([self.x_axis_body, self.y_axis_body, self.z_axis_body]))
