"""What a tracker measures, corrected: angles on its focal plane, and magnitudes."""

from pydantic import Field

from service.missions.strict import Strict


class Calibration(Strict):
    """Focal-plane calibration: measured angles to true ones.

    With u, v the measured `h_deg`, `v_deg`, each true angle is
    scale (measured + sum of coefficient u^i v^j) over terms [i, j, coefficient].
    """

    scale: float = Field(default=1.0, gt=0.5, lt=2)
    h_terms: tuple[tuple[int, int, float], ...] = ()
    v_terms: tuple[tuple[int, int, float], ...] = ()


class Magnitudes(Strict):
    """Calibration of a tracker's magnitudes: measured ones to those of the run catalog.

    The magnitude of a star is zero_mag + scale * measured.  The run catalog has V, plus the
    polynomial of the mission's `catalog`, plus (B-V) times the mean `color_mag` of the trackers.
    """

    zero_mag: float = Field(default=0.0, ge=-30, le=30)
    scale: float = Field(default=1.0, gt=0.5, lt=2)
    color_mag: float = Field(default=0.0, ge=-2, le=2)


AS_MEASURED = Magnitudes()
