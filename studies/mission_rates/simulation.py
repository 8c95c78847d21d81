"""Parameter sweep: settings to vary, and simulated views for each, zone by zone on all cores.

A setting of the mission (tolerances and zone) has the name of its key in the mission file; the
others are simulated errors.  All settings see the same zones, views, stars and random draws, as
every run of the paper did: differences between settings are not due to the draws, which depend on
the seed and the zone's number alone, not on the distribution of the work.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import ValidationError
from tqdm import tqdm

from service.acquire import BatchColumns, acquire_many
from service.acquire.choices import idle_reason
from service.errors import BadInput, Fault, shown_value
from service.intervals import Interval, share_of
from service.missions.mission import Band, Identifier, Mission, Tolerances
from service.simulate.motion import random_axis, tilted
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import open_catalog
from service.sky.model import SkyModel
from service.vectors import Vector, from_ra_dec, to_ra_dec
from studies.paper_1994 import tally
from studies.paper_1994.printed import PrintedCounts, Reference, Run, World
from studies.paper_1994.views import EPOCH, View, batch_of, draw_zone
from studies.workers import mapping, number_of

MOST_SETTINGS = 400
MOST_DIGITS = 12
"""Decimals to which values of a range are rounded, so that .3 + 3 * .2 gives 0.9."""
BOUND_SIGMAS = 6.0
"""Bound of magnitude errors in sigmas: RCMAG is six times SIGMAG in the paper's Table 1."""


@dataclass(frozen=True)
class Errors:
    """Simulated errors, with the paper's names.

    `phi_deg`, `theta_deg`, `psi_deg` (LIBROT) rotate the observed vectors about the body axes Z,
    then Y, then X.  `off_axis_deg` (RCVIEW) bounds the angle from the zone's axis to the boresight,
    for a band from the pole to the body axis of the band. `position_error_arcsec` is a standard
    deviation per tangent axis: SIGOBS, the deviation of the paper's radial error, is sqrt(2) times
    it.  `magnitude_error_mag` is SIGMAG, and `magnitude_bound_mag` RCMAG.
    """

    phi_deg: float
    theta_deg: float
    psi_deg: float
    off_axis_deg: float
    position_error_arcsec: float
    magnitude_error_mag: float
    magnitude_bound_mag: float


LIMITS = {
    "phi_deg": (-360.0, 360.0),
    "theta_deg": (-360.0, 360.0),
    "psi_deg": (-360.0, 360.0),
    "off_axis_deg": (0.0, 180.0),
    "position_error_arcsec": (0.0, 3600.0),
    "magnitude_error_mag": (0.0, 10.0),
    "magnitude_bound_mag": (0.001, 100.0),
}
SIZES = ("radius_deg", "half_width_deg")
"""Keys for the size of a cap and of a band, in the table `zone` of a mission file."""


@dataclass(frozen=True)
class Setting:
    """One point of a sweep: swept values by name, and the resulting mission and errors."""

    values: Mapping[str, float]
    mission: Mission
    errors: Errors


@dataclass(frozen=True)
class Sweep:
    """A setting of a simulation, with the values over which it is swept."""

    name: str
    values: tuple[float, ...]

    @classmethod
    def parsed(cls, text: str) -> Self:
        """Parse NAME=V1,V2,... or NAME=FIRST:LAST:STEP; raises `BadInput`.

        The unit at the end of a name may be omitted.
        """
        name, equals, written = text.partition("=")
        named = _full_name(name.strip())
        if not equals or named is None:
            known = ", ".join(_names())
            message = f"must be NAME=VALUES with one of {known}"
            raise BadInput(Fault("--sweep", message, shown_value(text)))
        try:
            values = _values(written)
        except ValueError:
            message = "must be values such as .01,.02,.05 or a range such as .3:.9:.2"
            raise BadInput(Fault(f"--sweep {named}", message, shown_value(written))) from None
        if not 1 <= len(values) <= MOST_SETTINGS:
            message = f"must have 1 to {MOST_SETTINGS} values"
            raise BadInput(Fault(f"--sweep {named}", message, shown_value(written)))
        return cls(named, tuple(dict.fromkeys(values)))


def _names() -> list[str]:
    return [*Tolerances.model_fields, *SIZES, *LIMITS]


def _full_name(name: str) -> str | None:
    return next((full for full in _names() if name in (full, full.rpartition("_")[0])), None)


def _values(text: str) -> list[float]:
    if ":" not in text:
        values = [float(part) for part in text.split(",")]
    else:
        first, last, step = map(float, text.split(":"))
        if not (step > 0.0 and math.isfinite(first) and math.isfinite(last)):
            raise ValueError
        # A small addition, so that rounding does not lose the last value.
        count = int((last - first) / step + 1e-9) + 1 if last >= first else 0
        values = [
            float(f"{first + k * step:.{MOST_DIGITS}g}")
            for k in range(min(count, MOST_SETTINGS + 1))
        ]
    if not all(map(math.isfinite, values)):
        raise ValueError
    return values


def one_tracker(mission: Mission, tracker: str | None) -> Mission:
    """Mission reduced to one tracker, by default its first, without search of the whole sky.

    A cap is centred on the tracker's boresight, which becomes the zone's axis.  Raises `BadInput`
    for a tracker that the mission does not have.
    """
    chosen = mission.trackers[0] if tracker is None else mission.tracker(tracker, "--tracker")
    zone = mission.zone
    if not isinstance(zone, Band):
        zone = zone.model_copy(update={"axis_body": tuple(chosen.boresight_body.tolist())})
    update = {"trackers": (chosen,), "zone": zone, "packets": None, "lost_in_space_fallback": False}
    return mission.model_copy(update=update)


def usual_errors(mission: Mission) -> Errors:
    """Errors that a mission with one tracker is designed for, with an exact a priori attitude.

    The boresight is as far from the zone's axis as the field of view fits in the zone.
    """
    tracker, zone = mission.trackers[0], mission.zone
    size_deg = zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg
    return Errors(
        phi_deg=0.0,
        theta_deg=0.0,
        psi_deg=0.0,
        off_axis_deg=max(0.0, size_deg - tracker.field_of_view_radius_deg),
        position_error_arcsec=tracker.sigma_arcsec,
        magnitude_error_mag=tracker.magnitude_sigma_mag,
        magnitude_bound_mag=BOUND_SIGMAS * tracker.magnitude_sigma_mag,
    )


def settings_of(mission: Mission, sweeps: Sequence[Sweep]) -> list[Setting]:
    """All combinations of the swept values; the last sweep varies fastest.

    The bound of a swept magnitude error changes with it, unless swept itself.  Raises `BadInput`
    naming a value that a mission file may not have, or too many combinations.
    """
    names = [sweep.name for sweep in sweeps]
    for name in names:
        if names.count(name) > 1:
            raise BadInput(Fault("--sweep", "must name a setting once", name))
    count = math.prod(len(sweep.values) for sweep in sweeps)
    if count > MOST_SETTINGS:
        message = f"must make at most {MOST_SETTINGS} combinations"
        raise BadInput(Fault("--sweep", message, str(count)))
    errors = usual_errors(mission)
    return [
        _setting(mission, errors, dict(zip(names, values, strict=True)))
        for values in itertools.product(*(sweep.values for sweep in sweeps))
    ]


def _setting(mission: Mission, errors: Errors, values: Mapping[str, float]) -> Setting:
    own = {name: value for name, value in values.items() if name in LIMITS}
    for name, value in own.items():
        least, most = LIMITS[name]
        if not least <= value <= most:
            message = f"must be from {least:g} to {most:g}"
            raise BadInput(Fault(f"--sweep {name}", message, shown_value(value)))
    if "magnitude_error_mag" in own and "magnitude_bound_mag" not in own:
        own["magnitude_bound_mag"] = max(
            BOUND_SIGMAS * own["magnitude_error_mag"], LIMITS["magnitude_bound_mag"][0]
        )
    of_mission = {name: value for name, value in values.items() if name not in LIMITS}
    changed = _with(mission, of_mission) if of_mission else mission
    return Setting(values, changed, replace(errors, **own))


def _with(mission: Mission, values: Mapping[str, float]) -> Mission:
    """Mission with changed tolerances or zone size."""
    tables: dict[str, Any] = {
        "zone": mission.zone.model_dump(),
        "tolerances": mission.tolerances.model_dump(),
    }
    for name, value in values.items():
        if name in SIZES and name not in tables["zone"]:
            kind = mission.zone.kind
            message = f"{mission.name} has a {kind}, which has no such size"
            raise BadInput(Fault(f"--sweep {name}", message, shown_value(value)))
        tables["zone" if name in SIZES else "tolerances"][name] = value
    try:
        zone = type(mission.zone).model_validate(tables["zone"])
        tolerances = Tolerances.model_validate(tables["tolerances"])
    except ValidationError as error:
        first = error.errors()[0]
        field = f"--sweep {'.'.join(map(str, first['loc']))}"
        raise BadInput(Fault(field, first["msg"], shown_value(first["input"]))) from None
    return mission.model_copy(update={"zone": zone, "tolerances": tolerances})


def options_of_settings(sweeps: Sequence[Sweep], tests: Mapping[str, bool]) -> dict[str, str]:
    """Tests and tolerances to change, each with the option that requests it."""
    switches = {True: "--with", False: "--without"}
    options = {name: switches[is_on] for name, is_on in tests.items()}
    swept = [each.name for each in sweeps if each.name in Tolerances.model_fields]
    return options | dict.fromkeys(swept, "--sweep")


def refuse_idle(options: Mapping[str, str], mission: Mission, identifier: str) -> None:
    """Raise `BadInput` naming an option whose test or tolerance has no effect."""
    for name, option in options.items():
        reason = idle_reason(name, identifier, mission.tests, mission.zone)
        if reason is not None:
            raise BadInput(Fault(f"{option} {name}", f"{reason} and would change nothing"))


def sigobs_arcsec(errors: Errors) -> float:
    """Standard deviation of the paper's radial position error (SIGOBS), in arcsec."""
    return float(np.sqrt(2.0)) * errors.position_error_arcsec


assert {each.name for each in fields(Errors)} == set(LIMITS)


CACHE_BYTES = 64 << 20
LEAST_SIGMA_MAG = 1e-9
"""Magnitude sigma that replaces zero, since the bound is divided by it."""
OUTCOMES = {
    "unique_right": tally.CORRECT,
    "ambiguous": tally.AMBIGUOUS,
    "unmatched": tally.UNMATCHED,
    "wrong": tally.MISIDENTIFIED,
}


@dataclass(frozen=True)
class Plan:
    """Plan of a simulation: zones about random axes over the sky, or near a direction.

    `within_deg` is RCCAT; `tests` are switched on or off.  Each zone has `views` fields of view
    with at most `most_stars` observed stars each.  All settings are of one tracker.
    """

    settings: tuple[Setting, ...]
    identifier: Identifier
    tests: Mapping[str, bool]
    direction_deg: tuple[float, float] | None
    within_deg: float
    zones: int
    views: int
    most_stars: int
    seed: int


@dataclass(frozen=True)
class Rates:
    """Shares of a setting's stars by outcome, with 95 % intervals.

    Stars of a zone are not independent: the intervals are based on the number of zones.
    """

    setting: Setting
    stars: int
    unique_right: Interval
    ambiguous: Interval
    unmatched: Interval
    wrong: Interval


def simulate(
    plan: Plan, catalog: Path | None = None, processes: int | None = None, quiet: bool = False
) -> list[Rates]:
    """Simulate all settings of a plan, and return their rates.

    `catalog` is a star catalog of the site's own.  `processes` is the number of workers, all cores
    if None; 1 works in this process.  Raises `BadInput` if a zone would have too many pairs.
    """
    count = min(number_of(processes), plan.zones)
    task = partial(_zone_counts, plan, catalog)
    with (
        tqdm(total=plan.zones, unit="zone", disable=True if quiet else None) as bar,
        mapping(count) as mapped,
    ):
        found = []
        for counts in mapped(task, range(plan.zones)):
            found.append(counts)
            bar.update()
    by_setting = np.stack(found, axis=1)
    return [_rates(*each) for each in zip(plan.settings, by_setting, strict=True)]


def _rates(setting: Setting, counts: tally.Integers) -> Rates:
    """Rates with intervals from counts of stars (zones, 4)."""
    total = counts.sum(axis=1)
    zone = np.repeat(np.arange(len(total)), total)
    kind = np.concatenate([np.repeat(np.arange(4), row) for row in counts])
    shares = {name: share_of(kind == outcome, zone) for name, outcome in OUTCOMES.items()}
    return Rates(setting=setting, stars=int(total.sum()), **shares)


def zone_counts(plan: Plan, number: int, sky: SkyModel) -> tally.Integers:
    """Numbers of one zone's stars by outcome: (settings, 4) in the order of `tally`."""
    counts = np.zeros((len(plan.settings), 4), np.int64)
    for off_axis_deg in {setting.errors.off_axis_deg for setting in plan.settings}:
        views = list(_views(plan, number, off_axis_deg, sky))
        for place, setting in enumerate(plan.settings):
            if setting.errors.off_axis_deg == off_axis_deg:
                run, mission = _run(setting.errors), setting.mission
                batches = [batch_of(view, run, mission, plan.identifier) for view in views]
                found = acquire_many(BatchColumns.of(batches), mission, sky)
                for row, view in enumerate(views):
                    identified = found.acquisition(row).trackers[0].identification
                    counts[place] += tally.counts_of(identified, view.star)
    return counts


def _views(plan: Plan, number: int, off_axis_deg: float, sky: SkyModel) -> Iterator[View]:
    rng = np.random.default_rng([plan.seed, number])
    mission = plan.settings[0].mission
    ra_deg, dec_deg = to_ra_dec(_axis(plan, rng))
    world = World(
        name=mission.name,
        mission=mission.name,
        off_axis_deg=off_axis_deg,
        zones=1,
        views=plan.views,
        axis_deg=(float(ra_deg), float(dec_deg)),
    )
    run_catalog = sky.run_catalog(mission, EPOCH)
    drawn = draw_zone(world, number, mission, run_catalog, rng, plan.most_stars)
    return (view for view in drawn if len(view.star))


def _axis(plan: Plan, rng: np.random.Generator) -> Vector:
    if plan.direction_deg is None:
        return random_axis(rng)
    direction = from_ra_dec(*plan.direction_deg)
    half_sine = math.sin(math.radians(plan.within_deg) / 2.0) * math.sqrt(rng.uniform())
    return tilted(direction, 2.0 * math.asin(half_sine), rng)


def _run(errors: Errors) -> Run:
    """Run of the paper's simulator with given errors, without printed counts."""
    angles = (3600.0 * errors.phi_deg, 3600.0 * errors.theta_deg, 3600.0 * errors.psi_deg)
    return Run(
        table="",
        run="",
        world="",
        rotation_arcsec=angles,
        sigma_arcsec=sigobs_arcsec(errors),
        sigma_mag=max(errors.magnitude_error_mag, LEAST_SIGMA_MAG),
        bound_mag=errors.magnitude_bound_mag,
        geometry=True,
        printed=PrintedCounts(0, 0, 0, 0),
        reference=Reference(0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )


def _zone_counts(plan: Plan, catalog: Path | None, number: int) -> tally.Integers:
    return zone_counts(plan, number, _sky(catalog))


@cache
def _sky(catalog: Path | None) -> SkyModel:
    return SkyModel(open_catalog(catalog), LruCache(CACHE_BYTES))
