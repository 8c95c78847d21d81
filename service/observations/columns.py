"""Many batches of observations as columns: arrays with a row for each batch, tracker or star.

The layout is that of Arrow's list arrays: trackers of batch i are the rows from
`tracker_offsets[i]` to before `tracker_offsets[i + 1]` of the columns by tracker, the stars of
tracker t the rows from `star_offsets[t]` to before `star_offsets[t + 1]` of the columns by star.
"""

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.observations.batch import ObservationBatch
from service.vectors import Vector

Integers = npt.NDArray[np.int64]


class BatchColumns(Struct, frozen=True, eq=False, gc=False):
    """Uncalibrated batches as columns: n batches of t trackers with m stars in all.

    | column | shape | |
    |---|---|---|
    | `batches` | (n,) | time, a priori knowledge, velocity and options of each |
    | `rates_deg_per_s` | (n, 3) | of the body, in body axes |
    | `tracker_offsets` | (n + 1,) | see above |
    | `tracker` | (t,) | names |
    | `star_offsets` | (t + 1,) | see above |
    | `vector` | (m, 3) | unit vectors in tracker axes, NaN where there are angles |
    | `angles_deg` | (m, 2) | h and v as measured, NaN where there are vectors |
    | `magnitude_mag` | (m,) | NaN: none |
    | `sigma_arcsec` | (m,) | NaN: the tracker's own |
    | `time_offset_s` | (m,) | the star's time less the batch's |
    """

    batches: Sequence[ObservationBatch]
    rates_deg_per_s: Vector
    tracker_offsets: Integers
    tracker: Sequence[str]
    star_offsets: Integers
    vector: Vector
    angles_deg: Vector
    magnitude_mag: Vector
    sigma_arcsec: Vector
    time_offset_s: Vector

    @classmethod
    def of(cls, batches: Sequence[ObservationBatch]) -> "BatchColumns":
        """Columns with the rates, trackers and stars of a sequence of batches."""
        seen = [each for batch in batches for each in batch.observations]
        return cls(
            batches=batches,
            rates_deg_per_s=joined([each.body_rates_deg_per_s for each in batches]).reshape(-1, 3),
            tracker_offsets=offsets_of([len(each.observations) for each in batches]),
            tracker=[each.tracker for each in seen],
            star_offsets=offsets_of([each.count for each in seen]),
            vector=joined([each.vector for each in seen], 3),
            angles_deg=joined([each.angles_deg for each in seen], 2),
            magnitude_mag=joined([each.magnitude_mag for each in seen]),
            sigma_arcsec=joined([each.sigma_arcsec for each in seen]),
            time_offset_s=joined([each.time_offset_s for each in seen]),
        )


def offsets_of(counts: Sequence[int]) -> Integers:
    """Index of the first element of each of several concatenated lists, and the end of the last."""
    return np.array([0, *accumulate(counts)])


def joined(parts: Sequence[Vector], *width: int) -> Vector:
    """The concatenation of arrays as a new array; for no arrays, zero rows of the given width."""
    if len(parts) == 1:
        return parts[0].copy()
    return np.concatenate(parts) if parts else np.empty((0, *width))
