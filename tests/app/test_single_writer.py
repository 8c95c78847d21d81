"""What a service does while another one writes to its database."""

import json
import time
from contextlib import ExitStack, closing

import pytest

from service.app.calibrations.estimates import CalibrationRequest
from service.app.factory import open_app
from service.app.serving.single_writer import SingleWriter
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.storage.store import Store
from tests.calibration.wrong_file import true_batches, write_mission_files

pytestmark = pytest.mark.parametrize("database", ["postgresql"], indirect=True)

WHO = "J. Operator"


def until(holds):
    """Wait until something holds; a service looks once a second whether another one writes."""
    begun = time.monotonic()
    while not holds():
        assert time.monotonic() - begun < 30.0
        time.sleep(0.05)


def test_one_that_stands_by_has_the_calibration_that_the_other_adopted(database, sky, tmp_path):
    write_mission_files(tmp_path)
    settings = Settings(database=database, missions=tmp_path / "assumed")
    with (
        closing(open_app(settings, serving=True)) as writing,
        closing(open_app(settings, serving=True)) as standby,
    ):
        file = writing.missions["TWO"].digest
        assert standby.missions["TWO"].digest == file
        sent = [submission_from_json(json.dumps(each)) for each in true_batches(sky, 30)]
        writing.submissions.submit_many(sent)
        wanted = CalibrationRequest("TWO")
        estimate = writing.calibrations.of_spacecraft(wanted)
        found = writing.calibrations.record(wanted, estimate, WHO)
        adopted = writing.adoptions.adopt(found.id, WHO).mission
        assert adopted != file
        until(lambda: standby.missions["TWO"].digest == adopted)
        writing.adoptions.revert("TWO", None, WHO)
        until(lambda: standby.missions["TWO"].digest == file)


def test_one_that_cannot_take_over_leaves_it_to_another(database):
    def fail():
        raise OSError("no mission can be read")

    with ExitStack() as stack:
        stores = [stack.enter_context(closing(Store(database, serving=True))) for _ in range(2)]
        failing, sound = writers = [SingleWriter(each) for each in stores]
        for each in writers:
            stack.callback(each.stop)
        with pytest.raises(OSError, match="no mission"):
            failing.start(fail, lambda: None)
        sound.start(lambda: None, lambda: None)
        until(lambda: sound.is_writing)
