"""Apps that track, over databases of both kinds."""

import json

import pytest

from service.app.factory import open_app
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json
from service.settings import Settings
from tests.tracking.passes import fly, tracked


@pytest.fixture
def opened(database):
    """Opens apps on the test's database whose XTE tracks; all are closed at the end."""
    held = []

    def open_one(**settings):
        mission = tracked(load_missions()["XTE"], **settings)
        held.append(open_app(Settings(database=database, replay_processes=0), mission))
        return held[-1]

    yield open_one
    for app in held:
        app.close()


@pytest.fixture
def app(opened):
    return opened()


@pytest.fixture(scope="session")
def flown(sky):
    """A short pass of XTE: a flip before batch 6."""
    mission = load_missions()["XTE"]
    return list(fly(mission, sky, 10, 3, flips=(6,)))


def send(app, body, **others):
    """The answer to a batch."""
    answered = app.submissions.submit(submission_from_json(json.dumps(body | others)))
    return json.loads(answered.body)
