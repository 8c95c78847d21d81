"""The quick start is true: its commands are run as they stand and give the outputs shown."""

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.waiting import wait_until
from tests.web.serving import is_ready

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(sh|text)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)

pytestmark = pytest.mark.skipif(
    not (shutil.which("curl") and shutil.which("bash")), reason="there is no curl on this machine"
)


@pytest.fixture
def folder(tmp_path):
    """A folder that looks like the checkout to who follows the quick start."""
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    return tmp_path


@pytest.fixture
def port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return str(free.getsockname()[1])


@pytest.fixture
def server(folder, port):
    """The first block starts it."""
    kind, start = BLOCKS[0]
    assert (kind, "acquire serve" in start) == ("sh", True)
    (folder / "outside").mkdir()
    command = ["bash", "-c", "exec " + moved(start, folder, port).strip()]
    process = subprocess.Popen(command, cwd=folder)
    wait_until(lambda: is_ready(process, f"http://127.0.0.1:{port}", "livez"), 600.0, every_s=0.05)
    yield
    process.send_signal(signal.SIGTERM)
    process.wait(timeout=60)


@pytest.mark.usefixtures("server")
def test_every_command_gives_the_output_that_is_shown(folder, port):
    shell = subprocess.Popen(
        ["bash", "--norc"],
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    with shell:
        for index, (kind, text) in enumerate(BLOCKS[1:], start=1):
            if kind == "sh":
                said = run(shell, moved(text, folder, port))
                shown = BLOCKS[index + 1][1] if BLOCKS[index + 1 : index + 2] else ""
                follows = index + 1 < len(BLOCKS) and BLOCKS[index + 1][0] == "text"
                assert said == (shown if follows else ""), text
        shell.stdin.close()
    # The checkout is as it was, and the folder outside is gone.
    assert sorted(each.name for each in folder.iterdir()) == [".venv", "docs", "tests"]


def moved(text, folder, port):
    """Commands with the folder and the port of a test in the place of the usual ones."""
    return text.replace("/tmp/acquire-quickstart", str(folder / "outside")).replace("8000", port)


@pytest.mark.usefixtures("server")
@pytest.mark.slow
def test_the_lines_of_the_readme_print_the_attitude_that_it_shows(folder, port):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = json.loads(re.search(r"with more digits than here:\n`(\[.*\])`", text).group(1))
    for language, program in (("sh", ["bash", "-c"]), ("python", [".venv/bin/python", "-c"])):
        (lines,) = re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        command = [*program, "set -e\n" * (language == "sh") + moved(lines, folder, port)]
        for _ in range(600):
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode == 0:
                break
            time.sleep(0.1)  # the service answers 503 until it is ready
        assert json.loads(done.stdout) == pytest.approx(shown, abs=1e-5), done.stderr


def run(shell, commands):
    """What the commands print, in the shell that all blocks share."""
    shell.stdin.write(f"{commands}\necho end-of-block\n")
    shell.stdin.flush()
    said = ""
    for line in shell.stdout:
        if line == "end-of-block\n":
            return said
        said += line.replace("\r\n", "\n")
    raise AssertionError(f"the shell ended after {said}")


def test_every_link_leads_to_a_file():
    for name in ("quickstart.md", "api.md"):
        text = (ROOT / "docs" / name).read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)#:]+)\)", text):
            assert (ROOT / "docs" / link).is_file(), (name, link)


def test_the_guide_knows_every_kind_of_problem():
    from service.web.requests.problems import PROBLEM_TYPES

    guide = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    for kind in PROBLEM_TYPES.values():
        assert f"| {kind.status} | `{kind.type}` |" in guide
