"""A mission: zone, tolerances, tests, run catalog and trackers, read from a TOML file.

The project's word names a setting; the paper's symbol stands in the comment, here and in the files
(Fink & Shoup 1994, Table 1).
"""

import difflib
import hashlib
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from service.errors import (
    BadConfiguration,
    BadInput,
    Fault,
    UnknownSpacecraft,
    shown_value,
)
from service.missions.camera import Camera
from service.missions.defaults import Completed, completed, needs
from service.missions.faults import PydanticFault, causes, dotted_key, explained, of_the_form_given
from service.missions.identifiers import IDENTIFIERS
from service.missions.motion import (
    GyroSettings,
    LiveFilterSettings,
    MotionSettings,
    SmoothingSettings,
    TrackingSettings,
)
from service.missions.packets import Packets
from service.missions.product_settings import DEFAULT_PRODUCTS, ProductSettings, beside
from service.missions.scan import Scan, SunTracker
from service.missions.strict import (
    Components,
    Direction,
    Strict,
    is_missing,
    require_right_handed,
)
from service.vectors import Matrix, Vector, read_only, unit

SHIPPED_FOLDER = Path(__file__).parent

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]


def _zero_or_wide(step_deg: float) -> float:
    if 0.0 < step_deg < LEAST_GRID_DEG:
        raise ValueError(f"must be 0, for exact zones, or at least {LEAST_GRID_DEG}")
    return step_deg


CAP_START = "1999-03-01T00:00:00.000Z"
"""Start of simulated telemetry with a cap, when XTE and SWAS were both operating."""
BAND_START = "1996-04-16T00:00:00.000Z"
"""Start of simulated telemetry with a band, at the end of SOHO's commissioning.  In mid January and
mid July its band crosses Carina, where stars are densest and a few in ten thousand are confused.
"""
LEAST_GRID_DEG = 0.01
GridStep = Annotated[float, Field(ge=0, le=10), AfterValidator(_zero_or_wide)]
if TYPE_CHECKING:
    Identifier = str
else:
    Identifier = Literal[tuple(IDENTIFIERS)]
SolverName = Literal["quest", "triad"]


class Cap(Strict):
    """A zone of the sky: a circular cap about the presumed boresight."""

    kind: Literal["cap"]
    axis_body: Direction
    """The spacecraft's boresight in body axes, which an a priori `boresight` refers to."""
    radius_deg: float = Field(gt=0, le=180)  # CCAP
    grid_deg: GridStep = 0.0
    """Step in degrees of the grid for a cached zone's axis; 0 for the exact zone."""


class Band(Strict):
    """A zone of the sky: a band about a circle around the catalog generation vector."""

    kind: Literal["band"]
    axis_body: Direction
    """The body axis along the band's pole, for SOHO the axis pointed at the Sun."""
    coelevation_deg: float = Field(gt=0, lt=180)  # COEL
    half_width_deg: float = Field(gt=0, le=90)  # WBAND
    grid_deg: GridStep = 0.0


class Tolerances(Strict):
    """The tolerances of star identification; a request may change any of them."""

    pair_separation_max_deg: float = Field(ge=0.01, le=60)  # HMAX
    separation_deg: float = Field(ge=0, le=5)  # SEPTOL
    magnitude_mag: float = Field(ge=0, le=30)  # XMTOL
    magnitude_order_mag: float = Field(ge=0, le=30)  # TMAGMX
    cross_product_deg: float = Field(ge=0, le=180)  # CAPMAX, in bands BANMAX
    pole_difference_deg: float = Field(default=0.13, ge=0, le=180)  # BANTOL1
    pole_angle_deg: float = Field(default=7.2, ge=0, le=180)  # BANTOL2
    fov_rotation_deg: float = Field(default=10.0, ge=0, le=180)
    """Tolerance of Van Bezooijen's test, not in the paper and off in the shipped missions."""


class Tests(Strict):
    """The switches of the identification tests; by default `pole` is on in bands only."""

    magnitude: bool = True
    cross_product: bool = True
    pole: bool = False
    fov_rotation: bool = False
    match_groups: bool = False


class ToleranceLimits(NamedTuple):
    """The tolerances of the pair tests in the form that kernels take, angles in radians."""

    separation: float  # SEPTOL
    magnitude: float  # XMTOL
    magnitude_order: float  # TMAGMX
    cross_product: float  # CAPMAX, in bands BANMAX
    pole_difference: float  # BANTOL1
    pole_angle: float  # BANTOL2
    fov_rotation: float


class Switches(NamedTuple):
    """Named tuple with true for each pair test that is on, in the form that kernels take."""

    magnitude: bool
    cross_product: bool
    pole: bool
    fov_rotation: bool


@dataclass(frozen=True, eq=False)
class Rules:
    """The tolerances and tests of an identification, also in the form that kernels take."""

    tolerances: Tolerances
    tests: Tests
    limits: ToleranceLimits
    switches: Switches


def rules_of(tolerances: Tolerances, tests: Tests) -> Rules:
    """The rules of an identification, converted from tolerances and tests."""
    return Rules(
        tolerances,
        tests,
        ToleranceLimits(
            separation=math.radians(tolerances.separation_deg),
            magnitude=float(tolerances.magnitude_mag),
            magnitude_order=float(tolerances.magnitude_order_mag),
            cross_product=math.radians(tolerances.cross_product_deg),
            pole_difference=math.radians(tolerances.pole_difference_deg),
            pole_angle=math.radians(tolerances.pole_angle_deg),
            fov_rotation=math.radians(tolerances.fov_rotation_deg),
        ),
        Switches(tests.magnitude, tests.cross_product, tests.pole, tests.fov_rotation),
    )


TESTS_OF_ROLL = ("cross_product", "fov_rotation")
"""Names of the tests that need the presumed roll, which an a priori boresight does not give."""


class RunCatalogSettings(Strict):
    """Settings for extracting the mission's run catalog from the star catalog."""

    magnitude_limit_mag: float = Field(ge=-2, le=15)
    epoch_step_years: float = Field(default=1.0, gt=0, le=100)
    """Step in years to which the time of a batch is rounded to choose its run catalog."""
    merge_within_arcsec: float = Field(default=60.0, ge=0, le=3600)
    merge_limit_mag: float | None = Field(default=None, ge=-2, le=15)
    """Faintest star whose light is added to a brighter one's on merging; None for no limit."""
    reject_neighbour_within_arcsec: float = Field(default=0.0, ge=0, le=3600)
    reject_neighbour_fainter_by_mag: float = Field(default=2.0, ge=0, le=30)
    reject_variable_amplitude_mag: float | None = Field(default=None, gt=0, le=30)
    reject_position_sigma_arcsec: float | None = Field(default=None, gt=0)
    color_polynomial_mag: tuple[float, ...] = ()
    """Coefficients of instrument magnitude = V + c0 + c1 (B-V) + c2 (B-V)^2 + ...; empty for V."""

    @cached_property
    def digest(self) -> str:
        """The run catalog's settings as text, part of the key of a cached run catalog."""
        return self.model_dump_json()

    def epoch_of(self, julian_year: float) -> float:
        """The epoch, in Julian years, of the run catalog for a time."""
        return round(julian_year / self.epoch_step_years) * self.epoch_step_years


class Calibration(Strict):
    """The focal-plane calibration of a tracker, from measured to true angles.

    With u, v the measured `h_deg`, `v_deg`, each true angle is
    scale (measured + sum of coefficient u^i v^j) over terms [i, j, coefficient].
    """

    scale: float = Field(default=1.0, gt=0.5, lt=2)
    h_terms: tuple[tuple[int, int, float], ...] = ()
    v_terms: tuple[tuple[int, int, float], ...] = ()


class Magnitudes(Strict):
    """The photometric calibration of a tracker, from its magnitudes to those of the run catalog.

    The magnitude of a star is zero_mag + scale * measured.  The run catalog has V, plus the
    polynomial of the mission's `catalog`, plus (B-V) times the mean `color_mag` of the trackers.
    """

    zero_mag: float = Field(default=0.0, ge=-30, le=30)
    scale: float = Field(default=1.0, gt=0.5, lt=2)
    color_mag: float = Field(default=0.0, ge=-2, le=2)


AS_MEASURED = Magnitudes()


FieldSide = Annotated[float, Field(gt=0, lt=120)]


class Tracker(Strict):
    """One star tracker: alignment with the body, field of view, and measurement errors."""

    name: Name
    x_axis_body: Components
    y_axis_body: Components
    z_axis_body: Components
    """The tracker's X, Y and Z axes in body components; +Z is the boresight."""
    field_of_view_radius_deg: float = Field(gt=0, le=60)  # FOVMAX
    field_of_view_deg: tuple[FieldSide, FieldSide] | None = Field(default=None, exclude=True)
    """Width along X and height along Y of a field of view that is no circle, in degrees.

    Its corners lie within `field_of_view_radius_deg`. It changes no answer: the check and the
    simulator use it.
    """
    limit_mag: float | None = Field(default=None, ge=-2, le=15, exclude=True)
    """The faintest magnitude that the tracker sees, used by the simulator; it changes no answer."""
    sigma_arcsec: float = Field(gt=0, le=3600)
    """Position error per tangent axis, one sigma in arcsec: radial SIGOBS over the root of two."""
    magnitude_sigma_mag: float = Field(gt=0, le=10)  # SIGMAG
    coelevation_deg: float | None = Field(default=None, gt=0, lt=180)
    """In bands, the coelevation of this tracker's boresight if it differs from the zone's."""
    calibration: Calibration = Calibration()
    magnitudes: Magnitudes = Field(default=AS_MEASURED, exclude_if=AS_MEASURED.__eq__)
    camera: Camera | None = None
    """The camera of a tracker that sends frames; its farthest corner bounds the field of view."""
    scan: Scan | None = Field(default=None, exclude_if=is_missing)

    @model_validator(mode="after")
    def _axes_are_right_handed(self) -> Self:
        require_right_handed(self.x_axis_body, self.y_axis_body, self.z_axis_body)
        return self

    @cached_property
    def body_from_tracker(self) -> Matrix:
        """The alignment matrix (3, 3) that turns tracker components into body components."""
        axes = np.column_stack([self.x_axis_body, self.y_axis_body, self.z_axis_body])
        u, _, vt = np.linalg.svd(axes)
        return read_only(u @ vt)

    @cached_property
    def least_cosine(self) -> float:
        """The cosine of the field of view's radius."""
        return math.cos(math.radians(self.field_of_view_radius_deg))

    @cached_property
    def boresight_body(self) -> Vector:
        """The boresight (3,) in body axes, the last column of the alignment matrix."""
        return read_only(self.body_from_tracker[:, 2].copy())


class Mission(Strict):
    """The settings of a mission's file: trackers, zone, tests, tolerances and solver."""

    retired: ClassVar[bool] = False
    name: Name
    description: str = ""
    a_priori_error_deg: float | None = Field(default=None, gt=0, le=180, exclude=True)
    """Largest error of the a priori attitude in degrees, about each axis, or of the pole in bands.

    It gives the default size of the zone. It changes no answer itself, so it is no part of the
    digest.
    """
    sun_pointed_axis_body: Direction | None = Field(default=None, exclude=True)
    """The body axis that is kept on the Sun, which makes the zone a band about that pole."""
    identifier: Identifier = "verified"
    solver: SolverName = "quest"
    lost_in_space_fallback: bool = True
    """True if the whole sky is searched where `verified` finds no good attitude in the zone."""
    zone: Annotated[Cap | Band, Field(discriminator="kind")]
    tolerances: Tolerances
    tests: Tests = Field(default=Tests(), validate_default=True)
    catalog: RunCatalogSettings
    trackers: tuple[Tracker, ...] = Field(min_length=1, max_length=16)
    products: ProductSettings = Field(default=DEFAULT_PRODUCTS, exclude_if=DEFAULT_PRODUCTS.__eq__)
    packets: Packets | None = Field(default=None, exclude_if=is_missing)
    """The space packet parameters that fill a batch; if missing, no part of the digest."""
    gyro: GyroSettings | None = Field(default=None, exclude_if=is_missing)
    motion: MotionSettings | None = Field(default=None, exclude_if=is_missing)
    """The model of body motion without a gyro; if missing, the defaults of `MotionSettings`."""
    tracking: TrackingSettings | None = Field(default=None, exclude_if=is_missing)
    live_filter: LiveFilterSettings | None = Field(default=None, exclude_if=is_missing)
    smoothing: SmoothingSettings | None = Field(default=None, exclude_if=is_missing)
    sun_tracker: SunTracker | None = Field(default=None, exclude_if=is_missing)

    @field_validator("trackers")
    @classmethod
    def _names_differ(cls, trackers: tuple[Tracker, ...]) -> tuple[Tracker, ...]:
        names = [tracker.name for tracker in trackers]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"each needs a name of its own; several are {', '.join(twice)}")
        return trackers

    @field_validator("packets")
    @classmethod
    def _packets_are_of_its_trackers(
        cls, packets: Packets | None, info: ValidationInfo
    ) -> Packets | None:
        # Invalid trackers are missing from the data, so nothing can be compared with them.
        known = [tracker.name for tracker in info.data.get("trackers", ())]
        for each in packets.trackers if packets and known else ():
            if each.tracker not in known:
                raise ValueError(f"trackers: {each.tracker}: the mission has {', '.join(known)}")
        for measured in packets.measurements if packets and known else ():
            if measured.tracker is not None and measured.tracker not in known:
                there_are = f"the mission has {', '.join(known)}"
                raise ValueError(f"measurements: {measured.tracker}: {there_are}")
        return packets

    @field_validator("tests")
    @classmethod
    def _pole_is_a_band_s(cls, tests: Tests, info: ValidationInfo) -> Tests:
        is_band = isinstance(info.data.get("zone"), Band)
        if "pole" not in tests.model_fields_set:
            return tests.model_copy(update={"pole": is_band})
        if tests.pole and not is_band and "zone" in info.data:
            raise ValueError("pole: a cap has no pole; false is allowed")
        return tests

    @cached_property
    def digest(self) -> str:
        """The `sha256:` digest of the mission's settings, independent of the file's layout."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return "sha256:" + hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def within_zones(self) -> "Mission":
        """The mission without the fallback to a search of the whole sky."""
        return self.model_copy(update={"lost_in_space_fallback": False})

    @cached_property
    def run_catalog_settings(self) -> RunCatalogSettings:
        """The settings of the run catalog, with the trackers' mean colour term added."""
        color_mag = math.fsum(each.magnitudes.color_mag for each in self.trackers)
        if color_mag == 0.0:
            return self.catalog
        zero, slope, *rest = (*self.catalog.color_polynomial_mag, 0.0, 0.0)
        terms = (zero, slope + color_mag / len(self.trackers), *rest)
        return self.catalog.model_copy(update={"color_polynomial_mag": terms})

    @cached_property
    def rules(self) -> Rules:
        """The mission's default rules: tolerances and tests."""
        return rules_of(self.tolerances, self.tests)

    @cached_property
    def rules_without_roll(self) -> Rules:
        """The mission's default rules without the tests that need a presumed roll."""
        tests = self.tests.model_copy(update=dict.fromkeys(TESTS_OF_ROLL, False))
        return rules_of(self.tolerances, tests)

    @property
    def knows_attitude(self) -> bool:
        """True unless the mission file states no a priori knowledge of the attitude."""
        is_lost = self.identifier == "lost_in_space" and self.sun_pointed_axis_body is None
        return not is_lost or self.a_priori_error_deg is not None

    @cached_property
    def presumed_error_deg(self) -> float:
        """Largest a priori attitude error in degrees about each axis, or of the pole in bands.

        If `a_priori_error_deg` is missing, the error is the size of the zone minus the field of
        view.
        """
        if self.a_priori_error_deg is not None:
            return self.a_priori_error_deg
        field_deg = max(each.field_of_view_radius_deg for each in self.trackers)
        if isinstance(self.zone, Band):
            return max(self.zone.half_width_deg - field_deg, 0.0)
        # Errors about the two axes perpendicular to the boresight add.
        return max(self.zone.radius_deg - field_deg, 0.0) / math.sqrt(2.0)

    @property
    def simulated_start(self) -> str:
        """Default start of simulated telemetry, whose files of the sky a first start builds."""
        return BAND_START if isinstance(self.zone, Band) else CAP_START

    @cached_property
    def axis_body(self) -> Vector:
        """The body axis (3,) about which the mission's zone lies, as a unit vector."""
        return read_only(unit(self.zone.axis_body))

    def tracker(self, name: str, field: str) -> Tracker:
        """Tracker with a given name; raises `BadInput` naming `field` and the known trackers."""
        for tracker in self.trackers:
            if tracker.name == name:
                return tracker
        known = ", ".join(tracker.name for tracker in self.trackers)
        raise BadInput(Fault(field, f"{self.name} has {known}", shown_value(name)))

    def camera_tracker(self, name: str | None, field: str) -> tuple[Tracker, Camera]:
        """Tracker with a given name, and its camera; by default the first tracker with a camera.

        Raises `BadInput` naming `field` if there is no camera.
        """
        trackers = self.trackers if name is None else (self.tracker(name, field),)
        for tracker in trackers:
            if tracker.camera is not None:
                return tracker, tracker.camera
        message = f"the mission file of {self.name} describes no camera of it"
        raise BadInput(Fault(field, message, shown_value(name or trackers[0].name)))


def parse_mission(text: str, file: str) -> Mission:
    """A mission read from TOML text; raises `BadConfiguration` naming file, key and values."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadConfiguration(f"{file}: not TOML: {error}") from None
    whole = completed(table)
    try:
        return Mission.model_validate(whole.table, context=beside(file))
    except ValidationError as error:
        faults = of_the_form_given(
            causes(error.errors()), lambda fault: dotted_key(Mission, fault["loc"])
        )
    found = [_described(fault) for fault in faults if not _is_waiting(fault, whole)]
    lacking = [*needs(table)]
    stated = {line.partition(":")[0] for line in lacking}
    found = [each for each in found if each.partition(":")[0] not in stated]
    lines = [*found, *lacking] or [_described(fault) for fault in faults]
    raise BadConfiguration("\n".join(f"{file}: {each}" for each in lines))


def _is_waiting(fault: PydanticFault, whole: Completed) -> bool:
    """True for a missing value whose default could not be computed from other values."""
    key = dotted_key(Mission, fault["loc"])
    within = (each == key or each.startswith(f"{key}.") for each in whole.waiting)
    return fault["type"] == "missing" and (any(within) or key.endswith("field_of_view_radius_deg"))


def _described(fault: PydanticFault) -> str:
    text = f"{dotted_key(Mission, fault['loc'])}: {explained(Mission, fault)}"
    # The message about a whole table already names the values that matter.
    of_a_table = fault["type"] == "value_error" and isinstance(fault["input"], dict)
    if fault["type"] == "missing" or of_a_table:
        return text
    return f"{text} (got {shown_value(fault['input'])})"


def read_mission(path: Path) -> Mission:
    """A mission read from a file; raises `BadConfiguration` naming the file and the fault."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise BadConfiguration(f"{path}: cannot be read: {error}") from None
    return parse_mission(text, str(path))


def load_missions(*places: Path | None, shipped: bool = True) -> dict[str, Mission]:
    """The shipped missions by name, together with those of a site's folders and files.

    A site's mission replaces a shipped one of the same name, and a mission from a file replaces any
    other. Raises `BadConfiguration` for a missing folder, and for one name in two files of folders.
    """
    return {name: mission for name, (mission, _) in mission_files(*places, shipped=shipped).items()}


def mission_files(*places: Path | None, shipped: bool = True) -> dict[str, tuple[Mission, Path]]:
    """The missions that `load_missions` gives, by name, each with the path of its file."""
    found: dict[str, tuple[Mission, Path]] = {}
    if shipped:
        found |= {
            each.name: (each, path)
            for path in _files(SHIPPED_FOLDER)
            for each in [read_mission(path)]
        }
    own: set[str] = set()
    searched: set[Path] = set()
    for place in filter(None, places):
        if (resolved := place.resolve()) in searched:
            continue
        searched.add(resolved)
        for path in [place] if place.suffix == ".toml" else _files(place):
            mission = read_mission(path)
            if mission.name in own and path != place:
                other = found[mission.name][1]
                raise BadConfiguration(f"{path}: name: {mission.name} is already in {other}")
            own.add(mission.name)
            found[mission.name] = mission, path
    return found


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise BadConfiguration(f"{folder}: no such folder of mission files (ACQUIRE_MISSIONS)")
    return sorted(folder.glob("*.toml"))


def mission_named(missions: Mapping[str, Mission], name: str) -> Mission:
    """Mission of a spacecraft; raises `UnknownSpacecraft` with the nearest name and all names."""
    try:
        return missions[name]
    except KeyError:
        pass
    upper = {each.upper(): each for each in sorted(missions)}
    near = difflib.get_close_matches(name.upper(), upper, n=1)
    meant = f"; did you mean {upper[near[0]]}?" if near else ""
    known = ", ".join(sorted(missions)) or "none"
    raise UnknownSpacecraft(f"no spacecraft {shown_value(name)}{meant}; there are {known}")
