"""Faults are drawn repeatably and change one node; those that the tests miss are named."""

import ast
import json
import subprocess
from collections import Counter

import pytest

from tests.mutants.__main__ import AREAS, ROOT, main
from tests.mutants.faults import draw, faults_of, replaced
from tests.mutants.tree import WRAPPED

EVERY_KIND = '''
"""A text: not a < b."""
LIMIT = 3


def decide(a: int = 4, b: "1 < 2" = 5):
    """Another text: a + b."""
    log.info("a number: %d", 6)
    if a < b and not f"{a + b}":
        a.append(min(b, -a))
    found: list[int] = [each - 1 for each in b if each]
    return found
'''
TOY = {
    "service/__init__.py": "",
    "service/sums.py": "def double(number):\n    return number + number\n",
    "service/signs.py": "def is_negative(number):\n    return number < 0\n",
    "tests/test_toy.py": """
import os
import subprocess
import sys

import pytest

from service.signs import is_negative


def test_a_sum_in_another_process():
    code = "from service.sums import double; print(double(2))"
    assert subprocess.check_output([sys.executable, "-c", code]).strip() == b"4"


def test_a_sign():
    assert is_negative(-1)
    assert not is_negative(1)


def test_that_fails_without_a_fault():
    assert is_negative(1)


@pytest.mark.skipif("--full" not in sys.argv, reason="takes long")
def test_the_boundary():
    assert not is_negative(0)
""",
    "tests/conftest.py": """
def pytest_addoption(parser):
    parser.addoption("--full", action="store_true")
""",
}


@pytest.fixture
def module(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(EVERY_KIND, "utf-8")
    return file


def test_every_kind_of_fault_is_found_and_nothing_else(module):
    assert {(fault.old, fault.new) for fault in faults_of(module.parent, module)} == {
        ('a < b and not f"{a + b}"', "a < b or not f'{a + b}'"),
        ('a < b and not f"{a + b}"', "not (a < b and (not f'{a + b}'))"),
        ("a < b", "a <= b"),
        ("a < b", "a >= b"),
        ('not f"{a + b}"', "f'{a + b}'"),
        ("a.append(min(b, -a))", "None"),
        ("min(b, -a)", "max(b, -a)"),
        ("-a", "a"),
        ("each", "not each"),
        ("each - 1", "each + 1"),
        ("1", "2"),
        ("found", "None"),
    }


def test_a_fault_changes_one_node(module):
    text = module.read_bytes()
    before = nodes_of(text)
    for fault in faults_of(module.parent, module):
        after = nodes_of(replaced(text, {0: fault}, "({new})"))
        assert (after - before).total() <= 1
        # A call or a value that None replaces goes with all that it holds.
        assert (before - after).total() <= 1 or fault.new == "None"
        assert after != before
        assert nodes_of(replaced(text, {0: fault}, "({old})")) == before


def nodes_of(text):
    """The expressions of a module, each with what it is without the expressions that it holds."""

    def own(value):
        if isinstance(value, list):
            return [own(each) for each in value]
        if isinstance(value, ast.operator | ast.unaryop | ast.boolop | ast.cmpop):
            return type(value).__name__
        return None if isinstance(value, ast.AST) else value

    return Counter(
        repr((type(node).__name__, [own(value) for _, value in ast.iter_fields(node)]))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.expr)
    )


def test_the_draw_depends_on_the_seed_alone():
    areas = {"alarms": AREAS["alarms"], "access": AREAS["access"]}
    drawn = draw(ROOT, areas, 1, 20)
    assert drawn == draw(ROOT, areas, 1, 20)

    def area(file):
        return next(name for name, folders in areas.items() if file.startswith(folders))

    assert [area(each.file) for each in drawn] == ["alarms", "access"] * 10
    assert len(set(drawn) & set(draw(ROOT, areas, 2, 20))) < 5
    others = draw(ROOT, areas, 1, 20, {drawn[0].identity})
    assert drawn[0] not in others
    assert len(set(drawn) & set(others)) >= 18


def test_all_faults_of_a_module_can_stand_in_it_at_once():
    drawn = draw(ROOT, {"access": AREAS["access"]}, 1, 60)
    for file in {fault.file for fault in drawn}:
        faults = {number: each for number, each in enumerate(drawn) if each.file == file}
        text = (ROOT / file).read_bytes()
        faulty = replaced(text, faults, WRAPPED)
        assert len(ast.parse(faulty).body) == len(ast.parse(text).body)
        assert faulty.count(b"\n") >= text.count(b"\n")


@pytest.fixture
def toy(tmp_path, monkeypatch):
    for name, text in TOY.items():
        (tmp_path / "toy" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "toy" / name).write_text(text, "utf-8")
    subprocess.run(["git", "init", "-q"], cwd=tmp_path / "toy", check=True)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path / "toy"


def test_what_the_sitting_misses_and_the_full_suite_kills_is_named(toy, capfd):
    def run():
        code = main(["--count", "4", "--jobs", "1"], toy, {"all": ("service",)})
        file = toy / ".mutants" / "results.jsonl"
        records = [json.loads(line) for line in file.read_text("utf-8").splitlines()]
        return code, capfd.readouterr().out, records

    code, printed, records = run()
    of = {(each["fault"].partition(": ")[2], each["suite"]): each for each in records}
    killed = of["number + number -> number - number", "sitting"]
    assert killed["outcome"] == "killed"
    assert killed["test"].endswith("::test_a_sum_in_another_process")
    assert of["number < 0 -> number <= 0", "sitting"]["outcome"] == "survived"
    assert of["number < 0 -> number <= 0", "full"]["test"].endswith("::test_the_boundary")
    assert code == 1
    assert "killed only by full" in printed
    assert "left out, because it fails without a fault: tests/test_toy.py::test_that" in printed
    again = run()
    assert again[0] == 1
    assert again[2] == records
