"""The image and its composition, read: what they hold and what they say."""

import os
import re
import subprocess
import sys
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
    compiling = last.index("\nRUN python -m service.acquire.prewarm")
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
