"""The client is built from its folder alone, and works with httpx and msgspec alone."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import pytest
from acquire_client import __version__
from packaging.requirements import Requirement

import service
from service.app.factory import open_app
from service.web.app import create_app
from tests.client.conftest import ROOT
from tests.web.serving import Server, in_process_settings

CLIENT = ROOT / "client"
DOCUMENT = (ROOT / "docs" / "client.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """A folder with what the wheel holds and what it requires, and nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    # A copy: nothing of the checkout but this folder can get into the wheel.
    copied = shutil.copytree(
        CLIENT, folder / "source", ignore=shutil.ignore_patterns("__pycache__")
    )
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=copied, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    installed = folder / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    required = tomllib.loads((CLIENT / "pyproject.toml").read_text())["project"]["dependencies"]
    for name in closure(required):
        for path in {path.parts[0] for path in distribution(name).files or ()} - {"..", "."}:
            place = installed / path
            if path != "__pycache__" and not place.exists():
                place.symlink_to(Path(distribution(name).locate_file(path)))
    return installed


def closure(requirements):
    """The names of all packages that these need."""
    names, waiting = set(), [Requirement(each) for each in requirements]
    while waiting:
        each = waiting.pop()
        if each.name.lower() in names or (each.marker and not each.marker.evaluate({"extra": ""})):
            continue
        names.add(each.name.lower())
        waiting += [Requirement(text) for text in distribution(each.name).requires or ()]
    return names


def run(environment, program, cwd=ROOT):
    """What a program prints that finds these packages only."""
    begin = f"import sys; sys.path.insert(0, {str(environment)!r})\n"
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", begin + program],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_the_client_alone(environment):
    (metadata,) = environment.glob("acquire_client-*.dist-info/METADATA")
    assert f"Version: {__version__}" in metadata.read_text(encoding="utf-8")
    source = CLIENT / "acquire_client"
    files = {str(path.relative_to(source)) for path in source.rglob("*.py")} | {"py.typed"}
    package = environment / "acquire_client"
    assert not (environment / "generate.py").exists()
    assert {str(p.relative_to(package)) for p in package.rglob("*") if p.is_file()} == files


def test_client_and_service_have_one_version():
    assert __version__ == service.__version__


def test_nothing_of_the_service_is_there_and_a_missing_package_is_named(environment):
    program = """
from importlib.util import find_spec
from acquire_client import Client, PackageMissing
from acquire_client.models import RunState
from acquire_client.tables import table_of
print([name for name in ("service", "numpy", "pydantic", "pandas", "pyarrow") if find_spec(name)])
try:
    table_of([], RunState)
except PackageMissing as error:
    print(error)
"""
    assert run(environment, program).splitlines() == [
        "[]",
        "this needs the package pyarrow; install it with: pip install pyarrow",
    ]


def test_the_examples_run_and_the_quick_start_prints_what_is_shown(environment, chosen_database):
    (lines, *others), (shown, *_) = (
        re.findall(rf"^```{kind}\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL)
        for kind in ("python", "text")
    )
    assert len(lines.splitlines()) <= 20
    with Server(create_app(open_app(in_process_settings(chosen_database())))) as url:
        program = "\n".join([lines, *others])
        assert run(environment, program.replace("http://127.0.0.1:8000", url)) == shown


def test_the_document_names_methods_and_errors_that_there_are():
    import acquire_client as client

    table = DOCUMENT.partition("## What it does")[2].partition("\n\n- ")[0]
    methods = set(re.findall(r"`([a-z_]+)`", table)) - {"at_once"}
    assert [name for name in methods if not hasattr(client.Client, name)] == []
    public = {name for name in vars(client.Client) if not name.startswith("_")}
    public |= {
        name
        for base in client.Client.__mro__[1:-1]
        for name in vars(base)
        if not name.startswith("_")
    }
    inner = {"get", "post", "stream", "close", "ping", "replays", "submit_json"}
    assert public - methods - inner == set()
    errors = DOCUMENT.partition("## Errors")[2]
    named = set(re.findall(r"`([A-Z][A-Za-z]+)`", errors.partition("\n\nA star")[0]))
    kinds = {
        name
        for name, value in vars(client).items()
        if isinstance(value, type) and issubclass(value, client.ClientError)
    }
    assert named == kinds
