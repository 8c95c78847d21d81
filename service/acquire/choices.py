"""The settings of one batch: its own options, completed by those of its mission."""

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from service.errors import BadBatch, Fault
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import (
    TESTS_OF_ROLL,
    Band,
    Cap,
    Identifier,
    Mission,
    Rules,
    SolverName,
    Tests,
    Tolerances,
    rules_of,
)
from service.observations.batch import BoresightPrior, ObservationBatch, PredictedPrior
from service.observations.schema import OptionsIn
from service.sky.ephemeris import observer_velocity
from service.vectors import Vector

TEST_OF_TOLERANCE = {
    "magnitude_mag": "magnitude",
    "magnitude_order_mag": "magnitude",
    "cross_product_deg": "cross_product",
    "pole_difference_deg": "pole",
    "pole_angle_deg": "pole",
    "fov_rotation_deg": "fov_rotation",
}
"""The test to which each tolerance belongs; while the test is off the tolerance has no effect."""


def idle_reason(name: str, identifier: str, tests: Tests, zone: Cap | Band) -> str | None:
    """The reason why a test or tolerance cannot change an answer; None if it can.

    This is the one table of the settings that act under each identifier, set of tests and kind of
    zone.
    """
    used = IDENTIFIERS[identifier].uses
    if used is not None and name not in used:
        return f"is not used by the identifier {identifier}"
    test = TEST_OF_TOLERANCE.get(name, name)
    if test == "pole" and not isinstance(zone, Band):
        return "is not used in a cap, which has no pole"
    if name in TEST_OF_TOLERANCE and not getattr(tests, test):
        return f"is not used while the test {test} is off"
    return None


TURNED_BY_NOISE_DEG = 3.0
"""Angle by which noise may rotate the direction of a close pair, in degrees."""
TURNED_IN_MARGINS = 2.0
"""Largest deviation of an attitude from its prediction, in zone margins (`search.contradicts`)."""


class Choices(Struct, frozen=True, eq=False, gc=False):
    """The effective settings of one batch: identifier, solver, rules and zone grid."""

    identifier: Identifier
    solver: SolverName
    rules: Rules
    zone_grid_deg: float

    @property
    def tolerances(self) -> Tolerances:
        """The tolerances of a batch's star identification."""
        return self.rules.tolerances

    @property
    def tests(self) -> Tests:
        """The switches of a batch's identification tests."""
        return self.rules.tests


def choices_of(batch: ObservationBatch, mission: Mission) -> Choices:
    """The effective settings of a batch: its options, else the mission's settings.

    Impossible tests are switched off: the pole test in a cap, which a predicted attitude has in
    bands too, and tests that need the roll if the prior is a boresight. With a prediction the cross
    product test is stricter.
    """
    options, grid_deg = batch.options, batch.options.zone_grid_deg
    predicted = batch.a_priori if isinstance(batch.a_priori, PredictedPrior) else None
    if options.tests or options.tolerances or predicted:
        rules = _own_rules(batch, mission, predicted)
    elif isinstance(batch.a_priori, BoresightPrior):
        rules = mission.rules_without_roll
    else:
        rules = mission.rules
    return Choices(
        options.identifier or mission.identifier,
        options.solver or mission.solver,
        rules,
        mission.zone.grid_deg if grid_deg is None else grid_deg,
    )


def _own_rules(
    batch: ObservationBatch, mission: Mission, predicted: PredictedPrior | None
) -> Rules:
    """The rules of a batch that has its own tests or tolerances, or a prediction."""
    options = batch.options
    tests = {**options.tests, **dict.fromkeys(impossible_tests(batch, mission), False)}
    tolerances = options.tolerances
    if predicted is not None:
        # A predicted roll is as accurate as the rest: a pair can have rotated only a little.
        most_deg = TURNED_BY_NOISE_DEG + TURNED_IN_MARGINS * predicted.margin_deg
        own_deg = min(most_deg, mission.tolerances.cross_product_deg)
        tolerances = {"cross_product_deg": own_deg} | tolerances
    return rules_of(
        mission.tolerances.model_copy(update=tolerances),
        mission.tests.model_copy(update=tests),
    )


def idle_options(batch: ObservationBatch, mission: Mission) -> dict[str, str]:
    """Tests and tolerances among a batch's options that have no effect, each with the reason."""
    options = batch.options
    if not (options.tests or options.tolerances):
        return {}
    choices = choices_of(batch, mission)
    named = (("tests", options.tests or {}), ("tolerances", options.tolerances or {}))
    reasons = {
        f"{table}.{name}": idle_reason(name, choices.identifier, choices.tests, mission.zone)
        for table, settings in named
        for name in settings
    }
    return {name: reason for name, reason in reasons.items() if reason is not None}


def refuse_idle_options(
    options: OptionsIn, batches: Sequence[ObservationBatch], mission: Mission, field: str
) -> None:
    """Raise `BadBatch` for optional tests and tolerances that have no effect on any of the batches.

    The batches include the options already; `field` is the location of the options for messages.
    """
    named = options.model_dump(include={"tests", "tolerances"}, exclude_none=True)
    asked = [f"{table}.{name}" for table, settings in named.items() for name in settings]
    if not (asked and batches):
        return
    idle = [idle_options(batch, mission) for batch in batches]
    faults = [
        Fault(f"{field}.{name}", f"{idle[0][name]} and would change nothing")
        for name in asked
        if all(name in each for each in idle)
    ]
    if faults:
        raise BadBatch(faults)


def impossible_tests(batch: ObservationBatch, mission: Mission) -> tuple[str, ...]:
    """Names of the tests that the kind of prior or the kind of zone makes impossible."""
    in_band = isinstance(mission.zone, Band) and not isinstance(batch.a_priori, PredictedPrior)
    pole = () if in_band else ("pole",)
    return pole + (TESTS_OF_ROLL if isinstance(batch.a_priori, BoresightPrior) else ())


def aberration_velocity(batch: ObservationBatch) -> Vector:
    """The observer's velocity (3,) in units of c for the aberration of catalog directions.

    It is zero if aberration is not to be corrected: directions then stay geometric.
    """
    if batch.aberration != "to_correct":
        return np.zeros(3)
    return observer_velocity(batch.time, batch.velocity_km_per_s)
