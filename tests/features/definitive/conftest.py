"""Apps whose XTE has a gyro, over databases of both kinds."""

import numpy as np
import pytest

from service.app.factory import open_app
from service.missions.mission import load_missions
from service.settings import Settings
from tests.features.definitive.passes import GYRO, MODEL, mission_with, recorded_of
from tests.features.definitive.simulated import attitudes_of, gyro_of, slews, truth_of


@pytest.fixture
def opened(database):
    """Opens apps on the test's database; all are closed at the end."""
    held = []

    def open_one(**tables):
        mission = mission_with(load_missions()["XTE"], **({"gyro": GYRO} | tables))
        held.append(open_app(Settings(database=database, replay_processes=0), mission))
        return held[-1]

    yield open_one
    for app in held:
        app.close()


@pytest.fixture
def app(opened):
    return opened()


@pytest.fixture(scope="session")
def half_hour():
    """Half an hour of slews: the truth, and what is recorded of it."""
    rng = np.random.default_rng(11)
    truth = truth_of(slews, 1800.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, 1801, 8), (6.0, 6.0, 40.0), rng)
    return truth, recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes)
