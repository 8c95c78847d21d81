"""The code stays readable in pieces: short modules and functions, few arguments, small folders."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

import service

ROOT = Path(service.__file__).parents[1]
FOLDERS = (ROOT / "service", ROOT / "studies", ROOT / "client")
MAX_MODULE_LINES, MAX_FUNCTION_LINES, MAX_ARGUMENTS, MAX_MODULES = 600, 80, 12, 25

# Still to be split.
LONG_MODULES: set[str] = set()
LONG_FUNCTIONS: set[str] = set()
FULL_FOLDERS: set[str] = set()


def name_of(path):
    return path.relative_to(ROOT).as_posix()


@pytest.fixture(scope="module")
def modules():
    return {
        path: path.read_text(encoding="utf-8")
        for each in FOLDERS
        for path in sorted(each.rglob("*.py"))
    }


@pytest.fixture(scope="module")
def functions(modules):
    """Every function of the service, kernels and methods included, by module and name."""
    return {
        f"{name_of(path)}:{node.name}": node
        for path, text in modules.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }


def test_there_is_something_to_measure(modules, functions):
    assert len(modules) > 300
    assert len(functions) > 1500


def test_no_module_is_too_long(modules):
    long = {name_of(path) for path, text in modules.items() if lines_of(text) > MAX_MODULE_LINES}
    assert long <= LONG_MODULES


def lines_of(text):
    return text.count("\n")


def test_no_function_is_too_long(functions):
    long = {
        name
        for name, node in functions.items()
        if node.end_lineno - node.lineno + 1 > MAX_FUNCTION_LINES
    }
    assert long <= LONG_FUNCTIONS


def test_no_function_takes_too_many_arguments(functions):
    def count(arguments):
        return len(arguments.posonlyargs + arguments.args + arguments.kwonlyargs)

    assert not {name for name, node in functions.items() if count(node.args) > MAX_ARGUMENTS}


def test_no_folder_holds_too_many_modules(modules):
    counts = Counter(name_of(path.parent) for path in modules)
    assert {folder for folder, count in counts.items() if count > MAX_MODULES} <= FULL_FOLDERS


NO_SUBJECT = re.compile(r"(Of|In (the )?place of|So (many|few|much|long|far)|That|Whether|Where)\b")


def docstrings(text):
    """The strings that describe modules, classes, functions, attributes and constants."""
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            match statement:
                case ast.Expr(ast.Constant(str(text))):
                    yield statement.lineno, text.strip()


def test_a_docstring_says_what_a_thing_is_without_its_name(modules):
    """One that begins with "Of a star" or "Whether it is" needs the name beside it."""
    begun = [
        f"{name_of(path)}:{line}: {text.splitlines()[0]}"
        for path, source in modules.items()
        for line, text in docstrings(source)
        if NO_SUBJECT.match(text)
    ]
    assert begun == []


def test_no_test_of_the_service_imports_a_benchmark():
    """What both use stands in `tests/reference` and `service/simulate`."""
    importing = re.compile(r"^\s*(from|import) benchmarks\b", re.MULTILINE)
    files = Path(__file__).parent.rglob("*.py")
    assert [f.name for f in files if importing.search(f.read_text(encoding="utf-8"))] == []


def test_the_service_does_not_import_scipy_stats():
    """The import takes seconds, and the caller would wait; `scipy.special` has the functions."""
    importing = re.compile(r"^\s*(from|import) scipy\.stats\b", re.MULTILINE)
    files = (ROOT / "service").rglob("*.py")
    assert [name_of(f) for f in files if importing.search(f.read_text(encoding="utf-8"))] == []


def test_only_the_feature_for_pictures_opens_images():
    """The main job answers the stars of a batch without a library for images."""
    importing = re.compile(r"^\s*(from|import) (PIL|sep|rawpy)\b", re.MULTILINE)
    files = (ROOT / "service").rglob("*.py")
    found = {name_of(f) for f in files if importing.search(f.read_text(encoding="utf-8"))}
    assert {name.partition("/pictures/")[0] for name in found} == {"service/features"}
