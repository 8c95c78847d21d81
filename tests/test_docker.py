"""The image and its composition, read: what they hold and what they say."""

import re
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


@pytest.mark.parametrize("named", ["token create", "ACQUIRE_HOST"])
def test_the_composition_says_how_access_is_controlled(named):
    assert "no access control" not in COMPOSE
    assert named in COMPOSE
