"""Errors that the stars of a picture share, where its lens was fitted on the picture itself.

The error of a star's place averages down with the number of stars.  That of the model of
the lens, of the catalog's epoch or of refraction does not: neighbours share it.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from service.identify.blind.lens import FREE_SCALE, SCALE_BEND, LensFit, fit_lens
from service.vectors import Vector

NEIGHBOURS = 3
LEAST_SIGMA_PX = 0.05


def shared_variance_px2(
    u_px: Vector, v_px: Vector, residual_px: Vector, variance_px2: float
) -> float:
    """The variance per axis, in square pixels, of errors that the stars (n) may share.

    The mean product of the residuals (n, 2) of neighbours, and beside it what so few stars
    do not show: `variance_px2` of the residuals over the root of n.
    """
    places = np.column_stack([u_px, v_px])
    _, near = cKDTree(places).query(places, k=min(NEIGHBOURS + 1, len(u_px)))
    products = (residual_px[:, None, :] * residual_px[near[:, 1:]]).sum(axis=-1)
    return max(0.5 * float(products.mean()), 0.0) + variance_px2 / math.sqrt(len(u_px))


def simpler_fit(
    fit: LensFit, u_px: Vector, v_px: Vector, star: Vector, residual_px: Vector
) -> LensFit | None:
    """The fit to stars (n, 3) without the lens's last parameters; None if it has a scale alone.

    How far its attitude lies from that of the whole fit tells how much the terms of the lens
    matter; those that are in no fit are not taken to matter less.
    """
    if fit.parameters == FREE_SCALE:
        return None
    fewer = FREE_SCALE if fit.parameters == SCALE_BEND else SCALE_BEND
    bend = fit.lens.bend if fewer == SCALE_BEND else 0.0
    start = replace(fit.lens, bend=bend, off_u=0.0, off_v=0.0)
    sigma = max(math.sqrt(float(np.mean(residual_px**2))), LEAST_SIGMA_PX)
    off = np.hypot(*residual_px.T)
    usual = max(2.0 * float(np.median(off)), LEAST_SIGMA_PX)
    return fit_lens(
        *(start, fit.attitude, u_px, v_px, np.full(len(u_px), sigma), star, fewer),
        weight=1.0 / (1.0 + (off / usual) ** 2),
    )
