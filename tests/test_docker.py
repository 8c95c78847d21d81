"""The image and its composition, read: what they hold and what they say."""

import ast
import json
import os
import re
import socket
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

DOCKER = Path(__file__).parent.parent / "docker"
DOCKERFILE = (DOCKER / "Dockerfile").read_text(encoding="utf-8")
COMPOSE = (DOCKER / "compose.yaml").read_text(encoding="utf-8")
BACKUP = DOCKER.parent / "service" / "storage" / "upkeep" / "backup.py"


def test_the_image_has_the_program_that_a_backup_of_postgresql_runs():
    assert '"pg_dump"' in BACKUP.read_text(encoding="utf-8")
    # Of the stage that runs, not of the one that builds.
    last = DOCKERFILE[DOCKERFILE.rindex("\nFROM ") :]
    installed = re.search(r"apt-get install ((?:[^&]|\\\n)+)", last)
    assert installed is not None
    assert "postgresql-client" in installed[1].split()
    # As root: the line that changes the user comes after it.
    assert installed.start() < last.index("\nUSER ")


def test_the_image_is_built_with_its_kernels_for_the_processor_that_it_runs_on():
    last = DOCKERFILE[DOCKERFILE.rindex("\nFROM ") :]
    compiling = last.index("\nRUN acquire prepare")
    # As the user of the service, whose folder of kernels it is; the settings stay for the run.
    assert last.index("\nUSER acquire") < compiling
    settings = dict(re.findall(r"\b(NUMBA_\w+)=(\S*)", last[:compiling]))
    assert settings["NUMBA_CPU_NAME"] == "$KERNEL_CPU"
    assert "NUMBA_CACHE_DIR" in settings
    cpu = re.search(r"ARG KERNEL_CPU=(\S+)", last)[1]
    # What is compiled is looked up by the processor's name alone, not by what the builder's has.
    code = (
        "from numba.core.registry import cpu_target as target\n"
        "print(target.target_context.codegen().magic_tuple()[1:])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ
        | {"NUMBA_CPU_NAME": cpu, "NUMBA_CPU_FEATURES": settings["NUMBA_CPU_FEATURES"]},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == str((cpu, ""))


@pytest.mark.parametrize("named", ["token create", "ACQUIRE_HOST"])
def test_the_composition_says_how_access_is_controlled(named):
    assert "no access control" not in COMPOSE
    assert named in COMPOSE


def test_the_image_has_the_packages_of_every_extra_that_the_service_asks_for():
    """Its user can install none: what a message would name is there."""
    root = DOCKER.parent
    lock = set(
        re.findall(r"^([\w.-]+)==", (DOCKER / "requirements.lock").read_text(), re.MULTILINE)
    )
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    asked = set()
    for path in [*(root / "service").rglob("*.py"), *(root / "studies").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        asked |= set(re.findall(r"require_extra\(\s*\"(\w+)\"|extra=\"(\w+)\"", text))
    names = {name for pair in asked for name in pair if name} | {"postgresql"}
    assert names >= {"tables", "packets", "tle"}
    for name in names & extras.keys():
        wanted = {re.match(r"[\w.-]+", each)[0].lower() for each in extras[name]}
        assert wanted <= lock, name
    copied = re.search(r"ARG LOCK=(\S+)", DOCKERFILE)[1]
    assert f"!{copied}" in (DOCKER / "Dockerfile.dockerignore").read_text().splitlines()


def test_whatever_the_service_imports_in_any_function_is_in_the_image():
    """As its user may run every command of the documents, and can install nothing."""
    root = DOCKER.parent
    lock = (DOCKER / "requirements.lock").read_text()
    locked = set(re.findall(r"^([\w.-]+)==", lock, re.MULTILINE))
    provided = metadata.packages_distributions()
    wanted = {}
    # The client is for programs of its users: its tables need packages that the image has not.
    for path in [*(root / "service").rglob("*.py"), *(root / "studies").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module] if isinstance(node, ast.ImportFrom) and not node.level else []
            names += [each.name for each in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                wanted.setdefault(name.partition(".")[0], path)
    # The last is a checkout's own: `catalog build` says so where there is none.
    own = {"service", "studies", "acquire_client", *sys.stdlib_module_names, "catalogs"}
    missing = {
        name: path
        for name, path in wanted.items()
        if name not in own
        and not locked & {each.lower().replace("_", "-") for each in provided.get(name, [name])}
    }
    assert len(wanted.keys() - own) > 20
    assert missing == {}


@pytest.mark.parametrize("host", [None, "", "127.0.0.1", "0.0.0.0", "::", "::1"])
def test_the_health_check_asks_where_the_service_listens(host):
    written = re.search(r"HEALTHCHECK [^[]*(\[.*?\])\nENTRYPOINT", DOCKERFILE, re.DOTALL)[1]
    program, *arguments = json.loads(written.replace("\\\n", ""))
    assert program == "python"
    family = socket.AF_INET6 if host and ":" in host else socket.AF_INET
    with socket.create_server(
        ("::1" if family == socket.AF_INET6 else "127.0.0.1", 0), family=family
    ) as listening:
        environment = os.environ | {"ACQUIRE_PORT": str(listening.getsockname()[1])}
        environment |= {} if host is None else {"ACQUIRE_HOST": host}
        asking = subprocess.Popen([sys.executable, *arguments], env=environment)
        connection, _ = listening.accept()
        with connection:
            assert connection.recv(1000).startswith(b"GET /readyz ")
            connection.sendall(b"HTTP/1.0 200 OK\r\n\r\n")
        assert asking.wait(20) == 0


def test_no_password_is_a_part_of_a_url():
    for file in DOCKER.glob("*.yaml"):
        for line in file.read_text().splitlines():
            assert not ("://" in line and "PASSWORD" in line), line
