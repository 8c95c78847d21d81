"""The result of every centroid method: a place with its errors, or why there is none."""

import math
from dataclasses import dataclass
from enum import StrEnum

from service.observations.scans.lines import BREAKDOWN_RATIO


class Flag(StrEnum):
    """A warning about a star's image."""

    SATURATED = "saturated"
    EDGE = "edge"
    BLENDED = "blended"
    TOO_FAINT = "too_faint"
    OUTSIDE = "outside_hump"
    MASKED = "masked_pixels"
    TRUNCATED = "truncated"
    NOT_CONVERGED = "not_converged"


@dataclass(frozen=True)
class CentroidRecord:
    """One star on the sensor.

    `u_px`, `v_px` count along columns and rows of the frame, the centre of its first
    pixel at (0, 0); `sigma_*` are predicted, one standard deviation per axis, and
    `correlation_uv` ties them.  `signal_ratio` is the light that the method sums over
    the noise of that sum.  `truncation_*_px` is the shift that light outside the
    window (and sampling) leaves in a plain moment: already taken off where the method
    knew the PSF.  Where `refused` says why, place and sigmas are NaN.
    """

    method: str
    u_px: float
    v_px: float
    sigma_u_px: float
    sigma_v_px: float
    correlation_uv: float
    flux_counts: float
    sigma_flux_counts: float
    signal_ratio: float
    truncation_u_px: float = 0.0
    truncation_v_px: float = 0.0
    iterations: int = 1
    flags: tuple[Flag, ...] = ()
    refused: str | None = None

    @property
    def usable(self) -> bool:
        """True if there is a place."""
        return self.refused is None


def refusal(
    method: str,
    why: str,
    flags: tuple[Flag, ...],
    flux_counts: float = math.nan,
    sigma_flux_counts: float = math.nan,
    signal_ratio: float = math.nan,
    iterations: int = 1,
) -> CentroidRecord:
    """A record without a place."""
    nan = math.nan
    return CentroidRecord(
        method, nan, nan, nan, nan, nan, flux_counts, sigma_flux_counts, signal_ratio,
        iterations=iterations, flags=flags, refused=why,
    )  # fmt: skip


def too_faint(
    method: str, flux_counts: float, sigma_flux_counts: float, flags: tuple[Flag, ...]
) -> CentroidRecord:
    """The refusal of light below the breakdown ratio."""
    ratio = flux_counts / sigma_flux_counts if sigma_flux_counts > 0.0 else 0.0
    why = f"its light is {ratio:.2f} times the noise, below {BREAKDOWN_RATIO:g}"
    return refusal(method, why, (*flags, Flag.TOO_FAINT), flux_counts, sigma_flux_counts, ratio)
