"""The record of a fitted shape: what `matched` and `recursive` give back."""

import math

from service.imaging.centroids.blending import is_blended
from service.imaging.centroids.psf import Psf
from service.imaging.centroids.record import (
    CentroidRecord,
    Flag,
    refusal,
    too_faint,
)
from service.imaging.centroids.shape_fit import Fit
from service.imaging.centroids.window import Window
from service.observations.scans.profile import BREAKDOWN_RATIO


def record_of(
    method: str, found: Fit | None, psf: Psf, half_width_px: int, window: Window
) -> CentroidRecord:
    """The record of a fit, or its refusal in words."""
    if found is None:
        return refusal(method, "the shape fits no light of this window", (Flag.OUTSIDE,))
    flags = found.region.flags(half_width_px)
    flux, sigma = found.flux_counts, math.sqrt(found.covariance[2, 2])
    if not found.signal_ratio >= BREAKDOWN_RATIO:
        return too_faint(method, flux, sigma, flags)
    if not found.converged:
        flags = (*flags, Flag.NOT_CONVERGED)
    if is_blended(found, psf):
        flags = (*flags, Flag.BLENDED)
    sigma_u, sigma_v = math.sqrt(found.covariance[0, 0]), math.sqrt(found.covariance[1, 1])
    return CentroidRecord(
        method=method,
        u_px=window.corner_u_px + found.u_px,
        v_px=window.corner_v_px + found.v_px,
        sigma_u_px=sigma_u,
        sigma_v_px=sigma_v,
        correlation_uv=float(found.covariance[0, 1]) / (sigma_u * sigma_v),
        flux_counts=flux,
        sigma_flux_counts=sigma,
        signal_ratio=found.signal_ratio,
        iterations=found.steps,
        flags=flags,
    )
