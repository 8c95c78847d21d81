"""Description of a simulated pass: length, stars, and periods with errors."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Literal, get_args

from service.errors import BadInput, Fault, shown_value
from service.missions.mission import Band, Mission
from service.observations.batch import MAX_STARS_PER_TRACKER, Aberration

PriorKind = Literal["quaternion", "direction", "mixed", "none"]
Kind = Literal["nominal", "attitude_error", "spurious", "magnitude_error", "position_error"]

CAP_CADENCE_S, BAND_CADENCE_S = 30.0, 300.0
CAP_ATTITUDE_ERROR_DEG, BAND_ATTITUDE_ERROR_DEG = 10.0, 5.0


@dataclass(frozen=True)
class Trouble:
    """A simulated error: its share of the pass, and its size in a unit of its own."""

    share: float = 0.0
    size: float | None = None


@dataclass(frozen=True)
class Troubles:
    """Simulated errors of a pass, one period per kind in this order; none for a share of zero.

    `attitude_error` grows through its period up to its size: about each axis in a cap, of the pole
    in a band (degrees).  `spurious` replaces that many real stars by false ones.  The sizes of
    `magnitude_error` (mag) and `position_error` (arcsec per tangent axis) are standard deviations
    that replace the tracker's own.
    """

    attitude_error: Trouble = Trouble(0.1)
    spurious: Trouble = Trouble(0.1, 1)
    magnitude_error: Trouble = Trouble(0.0, 0.5)
    position_error: Trouble = Trouble(0.0, 12.0)


_LARGEST = {
    "attitude_error": 180.0,
    "spurious": float(MAX_STARS_PER_TRACKER),
    "magnitude_error": 5.0,
    "position_error": 3600.0,
}

NO_TROUBLES = Troubles(Trouble(), Trouble(), Trouble(), Trouble())


@dataclass(frozen=True)
class Stretch:
    """Simulated error of one batch: its kind, its size, and the progress through it (0 to 1)."""

    kind: Kind = "nominal"
    size: float = 0.0
    progress: float = 0.0


USUAL_STARS = 5
"""Greatest number of stars of a tracker that sends no frames, as in the paper."""


def usual_stars(mission: Mission) -> int:
    """Largest number of stars that a mission's trackers report: their cameras' limit, if any."""
    cameras = [each.camera for each in mission.trackers if each.camera is not None]
    return max((each.most_stars for each in cameras), default=USUAL_STARS)


@dataclass(frozen=True)
class Pass:
    """All parameters of simulated telemetry; equal parameters give equal telemetry."""

    batches: int
    seed: int = 1
    start: str | None = None
    cadence_s: float | None = None
    stars: int = USUAL_STARS
    prior: PriorKind = "quaternion"
    angles_share: float = 0.25
    """Share of batches with stars as angles `h_deg`, `v_deg`; the others have vectors."""
    aberration: Mapping[Aberration, float] = field(default_factory=lambda: {"to_correct": 1.0})
    troubles: Troubles = Troubles()
    a_priori_error_deg: float | None = None
    """Largest error of the a priori attitude about each axis, in bands of the pole, in degrees;
    None: the mission's own.
    """
    noise_arcsec: float | None = None
    """Sigma of star positions along each tangent axis, in arcsec; None: that of each tracker."""
    false_stars: int = 0
    """Number of random points that replace real stars, in every batch."""
    missing_share: float = 0.0
    """Share of the stars in the field of view that the trackers do not report."""

    def __post_init__(self) -> None:
        _require(self.batches >= 1, "batches", "must be at least 1", self.batches)
        _require(self.seed >= 0, "seed", "must not be negative", self.seed)
        most = MAX_STARS_PER_TRACKER
        _require(1 <= self.stars <= most, "stars", f"must be from 1 to {most}", self.stars)
        cadence_s = 1.0 if self.cadence_s is None else self.cadence_s
        _require(0 < cadence_s <= 1e6, "cadence", "must be above 0 and at most 1e6 s", cadence_s)
        _require(0 <= self.angles_share <= 1, "angles", "must be from 0 to 1", self.angles_share)
        _require(
            self.prior in get_args(PriorKind), "prior", f"must be {_any_of(PriorKind)}", self.prior
        )
        for name, given, largest in (
            ("a_priori_error", self.a_priori_error_deg, 180.0),
            ("noise", self.noise_arcsec, 3600.0),
        ):
            within = given is None or 0 < given <= largest
            _require(within, name, f"must be above 0, to {largest:g}", given)
        most = MAX_STARS_PER_TRACKER
        within = 0 <= self.false_stars <= most
        _require(within, "false_stars", f"must be from 0 to {most}", self.false_stars)
        missing = self.missing_share
        _require(0 <= missing < 1, "missing", "must be from 0 to below 1", missing)
        for word, share in self.aberration.items():
            known = word in get_args(Aberration)
            _require(known, "aberration", f"must be of {_any_of(Aberration)}", word)
            _require(0 <= share <= 1, f"aberration {word}", "must be from 0 to 1", share)
        total = sum(self.aberration.values())
        _require(abs(total - 1) < 1e-9, "aberration", "the shares must add up to 1", total)
        shares = {each.name: getattr(self.troubles, each.name).share for each in fields(Troubles)}
        for name, share in shares.items():
            _require(0 <= share <= 1, f"{name} share", "must be from 0 to 1", share)
            size, largest = getattr(self.troubles, name).size, _LARGEST[name]
            within = size is None or 0 < size <= largest
            _require(within, name, f"must be above 0, to {largest:g}", size)
        total = sum(shares.values())
        _require(total <= 1, "shares", "the stretches must not be more than the pass", total)

    def error_deg_of(self, mission: Mission) -> float:
        """Largest error of the a priori attitude per axis, in bands of the pole, in degrees."""
        if self.a_priori_error_deg is None:
            return mission.presumed_error_deg
        return self.a_priori_error_deg

    def start_of(self, mission: Mission) -> str:
        """Time of the first batch of the pass."""
        return mission.simulated_start if self.start is None else self.start

    def cadence_of(self, mission: Mission) -> float:
        """Seconds from one batch to the next."""
        default = BAND_CADENCE_S if isinstance(mission.zone, Band) else CAP_CADENCE_S
        return default if self.cadence_s is None else self.cadence_s

    def stretches(self, mission: Mission) -> list[Stretch]:
        """Simulated error of each batch, or nominal; nominal batches lie evenly around errors."""
        in_band = isinstance(mission.zone, Band)
        default = BAND_ATTITUDE_ERROR_DEG if in_band else CAP_ATTITUDE_ERROR_DEG
        wanted = [
            (each.name, round(trouble.share * self.batches), trouble.size)
            for each in fields(Troubles)
            if (trouble := getattr(self.troubles, each.name)).share > 0
        ]
        free = self.batches - sum(count for _, count, _ in wanted)
        plan: list[Stretch] = []
        for place, (kind, count, size) in enumerate(wanted, start=1):
            before = sum(each.kind == "nominal" for each in plan)
            plan += [Stretch()] * (free * place // (len(wanted) + 1) - before)
            value = default if size is None else float(size)
            plan += [Stretch(kind, value, (k + 1) / count) for k in range(count)]  # type: ignore[arg-type]
        return (plan + [Stretch()] * self.batches)[: self.batches]


def _require(holds: bool, name: str, message: str, value: object) -> None:
    if not holds:
        raise BadInput(Fault(name, message, shown_value(value)))


def _any_of(words: object) -> str:
    return ", ".join(get_args(words))
