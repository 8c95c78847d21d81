"""Whether the light about a star is that of one star."""

import numpy as np
from scipy.ndimage import correlate

from service.imaging.centroids.psf import Psf
from service.imaging.centroids.shape_fit import Fit

BLEND_SIGMAS = 4.0
BLEND_SHARE = 0.01
"""A second star is told where it stands this far above the noise and holds this share of light."""


def is_blended(found: Fit, psf: Psf) -> bool:
    """Whether pixels hold light beside the star that its shape does not explain.

    What is left after the star is taken off, at its best place, is searched for a
    second one of the same shape about every pixel.
    """
    region = found.region
    du, dv = region.du - (found.u_px - region.column), region.dv - (found.v_px - region.row)
    model = found.flux_counts * psf.pixel(du, dv)
    gain = region.window.detector.gain_e_per_count
    variance = region.floor_variance + np.maximum(model, 0.0) / gain
    weight = np.zeros_like(variance)
    np.divide(1.0, variance, out=weight, where=region.usable & (variance > 0.0))
    near = np.arange(-2.0, 3.0)
    kernel = psf.pixel(near[None, :], near[:, None])
    summed = correlate((region.light - model) * weight, kernel, mode="constant")
    against = correlate(weight, kernel**2, mode="constant")
    told = against > 0.0
    second = summed[told] / against[told]
    above = summed[told] / np.sqrt(against[told])
    shown = (above > BLEND_SIGMAS) & (second > BLEND_SHARE * found.flux_counts)
    return bool(np.any(shown))
