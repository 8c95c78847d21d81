"""The wheel holds the service and all that it needs at run time, and nothing else."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import acquire_client
import pytest

import service

CHECKOUT = Path(__file__).parents[1]
PACKAGED = ["service", "client/acquire_client", "migrations", "catalogs"]
UV = Path(sys.executable).parent / "uv"


def built(source, folder):
    command = [UV, "build", "--wheel", "--no-build-isolation", "--offline", "--quiet"]
    # Without UV_PYTHON it would look for an interpreter of its own.
    named = os.environ | {"UV_PYTHON": sys.executable}
    subprocess.run([*command, f"--out-dir={folder}", source], check=True, env=named)
    (made,) = folder.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return built(CHECKOUT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def studies_wheel(tmp_path_factory):
    return built(CHECKOUT / "studies", tmp_path_factory.mktemp("studies"))


@pytest.fixture(scope="module")
def installed(wheel, studies_wheel, tmp_path_factory):
    """Runs both wheels in an empty folder, with the dependencies of this environment."""
    site = tmp_path_factory.mktemp("site")
    for each in (wheel, studies_wheel):
        with zipfile.ZipFile(each) as archive:
            archive.extractall(site)
    elsewhere = tmp_path_factory.mktemp("elsewhere")

    def run(*arguments):
        # The wheel comes before the checkout, whose path this environment has as well.
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=elsewhere,
            env=os.environ | {"PYTHONPATH": str(site)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    return site, run


def test_the_wheel_holds_every_file_of_the_package_and_the_shipped_data(wheel):
    listed = subprocess.run(
        ["git", "ls-files", *PACKAGED],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    shipped = {"catalogs/README.md", "catalogs/stars.npz"}
    wanted = {
        name.removeprefix("client/")
        if name.startswith(("service/", "client/"))
        else f"service/_shipped/{name}"
        for name in listed
        if (CHECKOUT / name).exists() and (not name.startswith("catalogs/") or name in shipped)
    }
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert wanted - held == set()
    assert {name.partition("/")[0] for name in held} == {"service", "acquire_client"}
    assert {name for name in held if name.endswith((".db", ".nbi", ".nbc", ".pyc"))} == set()


def test_the_wheel_of_the_studies_holds_their_files_and_needs_the_service_of_its_version(
    studies_wheel,
):
    listed = subprocess.run(
        ["git", "ls-files", "studies"], cwd=CHECKOUT, capture_output=True, text=True, check=True
    ).stdout.split()
    wanted = {each for each in listed if (CHECKOUT / each).exists()} - {"studies/pyproject.toml"}
    with zipfile.ZipFile(studies_wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
        (metadata,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        described = archive.read(metadata).decode()
    assert held == wanted
    assert f"Requires-Dist: attitude-acquisition=={service.__version__}\n" in described


def test_the_wheels_the_service_and_the_client_have_one_version(wheel, studies_wheel):
    versions = {each.name.split("-")[1] for each in (wheel, studies_wheel)}
    assert versions == {service.__version__} == {acquire_client.__version__}


COMMANDS = """
import service
from service.cli import main

print(service.__file__)
print(service.__version__)
assert main(["database", "check", "--fresh"]) == 0
assert main("catalog export --spacecraft XTE --epoch 2000 run.csv".split()) == 0
print(sum(1 for line in open("run.csv")))
"""


def test_its_commands_find_migrations_and_star_catalog_in_the_wheel(installed):
    site, run = installed
    place, version, *told, rows = run("-c", COMMANDS).splitlines()
    assert place.startswith(str(site))
    assert run("-m", "service.cli", "--version").split()[-1] == version
    assert "the schema is that of the code" in "\n".join(told)
    assert int(rows) > 1_000
    listed = run(
        "-c",
        "from importlib.metadata import entry_points as found; "
        "print(*found(group='acquire.commands'))",
    )
    assert "studies.commands:add" in listed
    assert "acquire simulate paper --table 3" in run(
        "-m", "service.cli", "simulate", "paper", "--help"
    )
