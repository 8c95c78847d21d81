"""What is watched of a spacecraft: each quantity with its unit and what it is made of."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

QuantityName = Literal[
    "ambiguous_share",
    "unmatched_share",
    "no_attitude_share",
    "suspect_share",
    "residual_rms_arcsec",
    "predicted_rms_arcsec",
    "residual_ratio",
    "magnitude_offset_mag",
    "a_priori_angle_deg",
    "batches_per_hour",
    "silence_s",
]


@dataclass(frozen=True)
class Quantity:
    """One quantity: `of` says what one batch adds, a share of counts or a value of its own."""

    unit: str
    of: Literal["stars", "batches", "value", "rate", "gap"]
    meaning: str


QUANTITIES: Mapping[QuantityName, Quantity] = {
    "ambiguous_share": Quantity("1", "stars", "ambiguous of all observed stars"),
    "unmatched_share": Quantity("1", "stars", "unmatched of all observed stars"),
    "no_attitude_share": Quantity("1", "batches", "batches without an attitude"),
    "suspect_share": Quantity("1", "batches", "batches whose attitude is suspect"),
    "residual_rms_arcsec": Quantity("arcsec", "value", "rms of the attitude's residuals"),
    "predicted_rms_arcsec": Quantity("arcsec", "value", "what its covariance predicts of it"),
    "residual_ratio": Quantity("1", "value", "residual rms over predicted"),
    "magnitude_offset_mag": Quantity("mag", "value", "observed less catalog, unique stars"),
    "a_priori_angle_deg": Quantity("deg", "value", "from the a priori attitude to the one found"),
    "batches_per_hour": Quantity("1/h", "rate", "batches in an hour of their own time"),
    "silence_s": Quantity("s", "gap", "since the latest batch"),
}

TRENDS: tuple[QuantityName, ...] = tuple(n for n, q in QUANTITIES.items() if q.of != "gap")
"""Quantities with a history."""
OF_A_BATCH: tuple[QuantityName, ...] = tuple(
    n for n, q in QUANTITIES.items() if q.of in ("stars", "value")
)
"""Quantities by which one batch is worse than another."""
