"""The page about a spacecraft of one's own is true: its commands give the outputs shown."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from service.acquire import acquire
from service.missions.mission import parse_mission
from service.observations.schema import submission_from_json
from tests.waiting import wait_until
from tests.web.serving import is_ready
from tests.web.test_quickstart import run

TEXT = (Path(__file__).parents[2] / "docs" / "own-spacecraft.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(sh|text)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
FIRST_START = "the first start on a machine compiles for one to two minutes\n"
"""Said on standard error until a service was started here; the page tells of it at its top."""
pytestmark = pytest.mark.skipif(
    not (shutil.which("curl") and shutil.which("bash")), reason="there is no curl on this machine"
)


def test_every_command_gives_the_output_that_is_shown(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("ACQUIRE_")
    } | {"PATH": path}
    shell = subprocess.Popen(
        ["bash", "--norc"],
        cwd=tmp_path,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    server = None
    try:
        for index, (kind, text) in enumerate(BLOCKS):
            commands = text.replace("8000", port)
            if kind == "text":
                continue
            if commands.startswith("acquire serve"):
                server = subprocess.Popen(
                    ["bash", "-c", f"exec {commands}"], cwd=tmp_path, env=environment
                )
                ready = (server, f"http://127.0.0.1:{port}", "readyz")
                wait_until(lambda ready=ready: is_ready(*ready), 600.0, every_s=0.05)
                continue
            follows = BLOCKS[index + 1 : index + 2]
            shown = follows[0][1] if follows and follows[0][0] == "text" else ""
            said = run(shell, commands).removeprefix(FIRST_START)
            assert said == shown.replace("8000", port), text
    finally:
        shell.stdin.close()
        shell.wait(timeout=60)
        shell.stdout.close()
        if server is not None:
            server.send_signal(signal.SIGTERM)
            server.wait(timeout=60)
    assert server is not None


def test_the_batch_on_the_page_is_one_of_the_mission_on_the_page(sky):
    (batch,) = re.findall(r"^```json\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
    (mission,) = [text for kind, text in BLOCKS if kind == "text" and "[[trackers]]" in text]
    read = submission_from_json(batch).batch
    assert acquire(read, parse_mission(mission, "mycube.toml"), sky).counts["observed"] == 2


def test_the_mission_on_the_page_has_ten_lines_at_most():
    (mission,) = [text for kind, text in BLOCKS if kind == "text" and "[[trackers]]" in text]
    assert len([line for line in mission.splitlines() if line]) <= 10
