"""What is promised of every feature: it can be switched off, and another package can bring one."""

import subprocess
import sys
from pathlib import Path

import pytest

from service.cli import build_parser
from service.errors import BadConfiguration
from service.feature import SHIPPED, Feature, features_on, known_features

FEATURES = Path(__file__).parents[2] / "service" / "features"


def commands_of(parser):
    return set(parser.commands.choices)


def test_every_folder_of_a_feature_is_in_the_list():
    assert set(SHIPPED) == {each.parent.name for each in FEATURES.glob("*/__init__.py")}
    assert {each.name for each in known_features().values()} >= set(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_feature_brings_what_it_says_and_has_a_folder_of_tests(name):
    feature = known_features()[name]
    for kind in feature.brings:
        assert (FEATURES / name / f"{kind}.py").exists()
    assert list((Path(__file__).parent / name).glob("test_*.py"))


def test_a_command_of_a_feature_that_is_off_is_not_there():
    assert "follow" in commands_of(build_parser())
    assert "follow" not in commands_of(build_parser(features_off="follow"))


def test_a_name_of_no_feature_is_refused_with_the_names_of_all(acquire, monkeypatch):
    monkeypatch.setenv("ACQUIRE_FEATURES_OFF", "follow, folow")
    code, _, complaint = acquire("version")
    assert code == 2
    assert "ACQUIRE_FEATURES_OFF: must be features of follow" in complaint
    assert "(got 'folow')" in complaint
    with pytest.raises(BadConfiguration, match="ACQUIRE_FEATURES_OFF"):
        features_on("folow")


def test_a_feature_can_only_bring_what_the_service_asks_for():
    with pytest.raises(ValueError, match="cannot bring colours"):
        Feature("paint", "paint", ("colours",))


SERVED = """
import sys
from service.app.factory import open_app
from service.cli import build_parser
from service.feature import SHIPPED
from service.settings import Settings
from service.web.app import create_app

off = ",".join(SHIPPED)
build_parser(off)
settings = Settings(database="sqlite:///" + sys.argv[1], replay_processes=0, features_off=off)
app = open_app(settings, serving=True)
create_app(app)
app.close()
print(*sys.modules)
"""


def test_of_features_that_are_off_nothing_is_imported(tmp_path):
    command = [sys.executable, "-c", SERVED, str(tmp_path / "acquire.db")]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = {each for each in run.stdout.split() if each.startswith("service.features.")}
    assert loaded == {f"service.features.{name}" for name in SHIPPED}
