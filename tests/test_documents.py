"""The documents point to what is there, and are finished."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from service import __version__

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "catalogs/*.md", "client/*.md")
    for path in ROOT.glob(pattern)
    if ".venv" not in path.parts
)
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
MAKE = re.compile(r"(?:^|`)make +([^\s`]+)", re.MULTILINE)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_to_a_file_leads_somewhere(document):
    for target in LINK.findall(document.read_text(encoding="utf-8")):
        if "://" not in target and not target.startswith("#"):
            place = document.parent / target.partition("#")[0]
            assert place.exists(), f"{document.name} links to {target}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_document_is_left_with_a_gap(document):
    assert "@@" not in document.read_text(encoding="utf-8")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_make_command_that_a_document_names_is_a_target(document):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([\w-]+):", makefile, re.MULTILINE))
    named = MAKE.findall(document.read_text(encoding="utf-8"))
    assert set(named) <= targets


PARTS = {
    "webhooks.md": ("body", "headers"),
}
"""Documents whose examples are parts of a program, and the names that it would have."""


@pytest.mark.parametrize(
    "document",
    [
        # Those that import the service's core take a checker of types half a minute.
        pytest.param(path, id=path.name, marks=pytest.mark.slow if of_core else ())
        for path in DOCUMENTS
        if (blocks := PYTHON.findall(path.read_text(encoding="utf-8")))
        for of_core in [any("from service." in each and "client" not in each for each in blocks)]
    ],
)
def test_every_example_passes_a_strict_checker_of_types(document, tmp_path):
    (tmp_path / "acquire_client").symlink_to(ROOT / "client" / "acquire_client")
    names = "".join(f"{name}: Any\n" for name in PARTS.get(document.name, ()))
    for k, block in enumerate(PYTHON.findall(document.read_text(encoding="utf-8"))):
        (tmp_path / f"example_{k}.py").write_text(f"from typing import Any\n{names}{block}")
    (tmp_path / "mypy.ini").write_text(
        f"[mypy]\nstrict = true\nmypy_path = {ROOT}:{tmp_path}\nfollow_imports = silent\n"
    )
    command = [sys.executable, "-m", "mypy", "--explicit-package-bases"]
    command += [
        f"--cache-dir={ROOT / '.mypy_cache' / 'examples'}",
        f"--config-file={tmp_path / 'mypy.ini'}",
    ]
    command += map(str, sorted(tmp_path.glob("example_*.py")))
    checked = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_the_version_is_one():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project.get("version", __version__) == __version__
    assert f"## {__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
