"""The settings of one batch: its own options, and its mission's for the others."""

import numpy as np
from msgspec import Struct

from service.missions.mission import (
    TESTS_OF_ROLL,
    Band,
    Identifier,
    Mission,
    Rules,
    SolverName,
    Tests,
    Tolerances,
    rules_of,
)
from service.observations.batch import BoresightPrior, ObservationBatch, PredictedPrior
from service.sky.ephemeris import observer_velocity
from service.vectors import Vector


class Choices(Struct, frozen=True, eq=False, gc=False):
    """The identifier, the solver, the rules and the zone grid of one batch."""

    identifier: Identifier
    solver: SolverName
    rules: Rules
    zone_grid_deg: float

    @property
    def tolerances(self) -> Tolerances:
        """The tolerances of the identification."""
        return self.rules.tolerances

    @property
    def tests(self) -> Tests:
        """The tests that are made."""
        return self.rules.tests


def choices_of(batch: ObservationBatch, mission: Mission) -> Choices:
    """The settings that hold for a batch.

    A test that cannot be made is off: the pole test in a cap, which a predicted attitude
    has in bands too, and tests that compare with the presumed roll where an a priori
    boresight leaves it open.
    """
    options = batch.options
    grid_deg = options.zone_grid_deg
    return Choices(
        options.identifier or mission.identifier,
        options.solver or mission.solver,
        _rules(batch, mission),
        mission.zone.grid_deg if grid_deg is None else grid_deg,
    )


def _rules(batch: ObservationBatch, mission: Mission) -> Rules:
    options, roll_open = batch.options, isinstance(batch.a_priori, BoresightPrior)
    in_cap = isinstance(batch.a_priori, PredictedPrior) and mission.tests.pole
    if not (options.tests or options.tolerances or in_cap):
        return mission.rules_without_roll if roll_open else mission.rules
    tests = {**options.tests, **dict.fromkeys(impossible_tests(batch, mission), False)}
    return rules_of(
        mission.tolerances.model_copy(update=options.tolerances),
        mission.tests.model_copy(update=tests),
    )


def impossible_tests(batch: ObservationBatch, mission: Mission) -> tuple[str, ...]:
    """The tests that a batch's a priori knowledge, or its mission's zone, does not allow."""
    in_band = isinstance(mission.zone, Band) and not isinstance(batch.a_priori, PredictedPrior)
    pole = () if in_band else ("pole",)
    return pole + (TESTS_OF_ROLL if isinstance(batch.a_priori, BoresightPrior) else ())


def aberration_velocity(batch: ObservationBatch) -> Vector:
    """The velocity (3,), in units of c, whose aberration the catalog is given for a batch.

    Zero where nothing is to be corrected: directions then stay geometric.
    """
    if batch.aberration != "to_correct":
        return np.zeros(3)
    return observer_velocity(batch.time, batch.velocity_km_per_s)
