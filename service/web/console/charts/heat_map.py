"""A heat map of spacecraft and time as packed numbers; the browser draws it."""

import base64

import numpy as np

from service.vectors import Matrix

LEVELS = 254
"""Steps of a share; a cell of 0 had no batch, one of 1 has the share 0."""


def packed(shares: Matrix) -> str:
    """A byte for each cell, row by row, as base64; NaN where there was no batch."""
    known = np.isfinite(shares)
    levels = 1 + np.rint(np.clip(np.where(known, shares, 0.0), 0.0, 1.0) * LEVELS)
    return base64.b64encode(np.where(known, levels, 0).astype(np.uint8).tobytes()).decode()
