"""What every test may ask for: one seed, the embedded sky, the shipped missions.

pytest --seed 7           other random draws, for hypothesis as well
pytest --batches 2000     batches per mission held against the plain implementation
pytest --database postgresql tests/web     the interface and its pages over PostgreSQL
pytest --full             everything, also what takes too long for a sitting
pytest --torture          tests of kills, failing disks and odd input at full size

Every test that asks for `database` runs on SQLite. It runs on PostgreSQL too if
TEST_POSTGRESQL_URL names a database to be used for tests, and if what the two do
differs there: where the test or its file has the mark `both_databases`, and everywhere
under --full.
"""

import ctypes
import faulthandler
import json
import logging
import os
import tomllib
from contextlib import ExitStack
from pathlib import Path

import hypothesis
import numba
import numpy as np
import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key

from service.cli import main
from service.missions.mission import load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage import progress
from tests import fresh_databases, scale
from tests.fresh_databases import sqlite_at
from tests.missions.stated_files import STATED_FOLDER
from tests.torture import FIGURES

DEFAULT_SEED = 19941026
TORTURE_TIMEOUT_S = 6 * 3600
OTHER_DATABASE = "needs no database of its choice"
M_MMAP_THRESHOLD = -3
"""Of glibc's malloc.h."""
LEFT_OUT, LEFT_OUT_BY_WORKERS = pytest.StashKey(), pytest.StashKey()

hypothesis.settings.register_profile(
    # Two shared cores: a deadline would fail on the machine, not on the code.
    "repeatable",
    derandomize=True,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
    database=None,
)
hypothesis.settings.register_profile(
    "seeded", hypothesis.settings.get_profile("repeatable"), derandomize=False
)


def pytest_addoption(parser):
    parser.addoption(
        "--seed", type=int, default=DEFAULT_SEED, help="seed of every random draw in the tests"
    )
    parser.addoption(
        "--batches",
        type=int,
        default=int(os.environ.get("TEST_BATCHES", "0")),
        help="batches per mission held against the plain implementation (80; --full: 240)",
    )
    parser.addoption(
        "--database",
        choices=("sqlite", "postgresql"),
        default="sqlite",
        help="what the tests of pages and of the interface keep their records in",
    )
    parser.addoption(
        "--full", action="store_true", help="also what takes too long for a sitting (an hour)"
    )
    parser.addoption(
        "--torture", action="store_true", help="kills, failing disks, odd input: at full size"
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config):
    if config.getoption("--torture"):
        os.environ.setdefault(scale.VARIABLE, "1")
    if config.getoption("--full"):
        os.environ.setdefault(scale.FULL, "1")
    seed = config.getoption("--seed")
    if seed == DEFAULT_SEED:
        hypothesis.settings.load_profile("repeatable")
    else:
        hypothesis.settings.load_profile("seeded")
        hypothesis.core.global_force_seed = seed
    # Arrays apart from the heap, in whose holes their memory would stay: a fifth of a worker's.
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        mallopt(M_MMAP_THRESHOLD, 256 << 10)


def pytest_collection_modifyitems(config, items):
    """Leave out what belongs to `make full`, and with --database what has no choice of it."""
    left = {}
    for item in items:
        why = _why_left_out(config, item)
        if why:
            left.setdefault(why, []).append(item)
    config.stash[LEFT_OUT] = {why: len(those) for why, those in left.items()}
    without = {id(item) for those in left.values() for item in those}
    if without:
        config.hook.pytest_deselected(items=[item for item in items if id(item) in without])
        items[:] = [item for item in items if id(item) not in without]


def _why_left_out(config, item):
    if config.getoption("--database") != "sqlite" and "chosen_database" not in item.fixturenames:
        return OTHER_DATABASE
    if scale.is_full():
        return None
    if _is_slow(item):
        return "slow"
    if _is_repeated_over_postgresql(item):
        return "repeated over PostgreSQL"
    return None


def _is_slow(item):
    """Whether a test is marked `slow`: wholly, or for parameters whose name holds what is named."""
    parameters = getattr(item, "callspec", None)
    return any(
        not mark.args or any(each in parameters.id for each in mark.args)
        for mark in item.iter_markers("slow")
    )


def _is_repeated_over_postgresql(item):
    """Whether a test runs over both databases, and is held for the same over both."""
    call = getattr(item, "callspec", None)
    # A parameter may be an array, whose comparison is no truth value.
    parameters = [] if call is None else call.params.values()
    if not any(isinstance(value, str) and value == "postgresql" for value in parameters):
        return False
    if item.get_closest_marker("both_databases"):
        return False
    # A test that names PostgreSQL itself is not a repetition.
    return not any("database" in mark.args[0] for mark in item.iter_markers("parametrize"))


def pytest_runtest_setup(item):
    """Hours, not the minutes of `faulthandler_timeout`, before a torture counts as hanging."""
    if item.config.getoption("--torture") and item.get_closest_marker("torture"):
        stderr = item.config.stash[fault_handler_stderr_fd_key]
        faulthandler.dump_traceback_later(TORTURE_TIMEOUT_S, exit=True, file=stderr)


def pytest_terminal_summary(terminalreporter, config):
    """What was left for `make full`, and what tests of endurance did, a line each."""
    left = {why: n for why, n in _left_out(config).items() if why != OTHER_DATABASE}
    if left:
        terminalreporter.section("left for `make full`")
        for why, number in sorted(left.items()):
            terminalreporter.line(f"{number} tests: {why}")
        terminalreporter.line("kills, disk faults and mutations: one try of each here, more there")
    told = [
        f"{report.nodeid}: {', '.join(f'{each} {figure}' for each, figure in value.items())}"
        for reports in terminalreporter.stats.values()
        for report in reports
        if getattr(report, "when", None) == "call"
        for name, value in report.user_properties
        if name == FIGURES
    ]
    if told:
        terminalreporter.section("figures")
        for line in sorted(told):
            terminalreporter.line(line)
    if late := kernels_compiled_twice():
        terminalreporter.section("kernels compiled for a second kind of arguments")
        for name in late:
            terminalreporter.line(name)


def kernels_compiled_twice():
    """Names of numba's files for further kinds of arguments; a post would wait for such a kernel.

    Of all processes that had this folder of kernels since the source was changed.  Kernels of
    tests do not count: a second run in the same checkout compiles those in functions again.
    """
    compiled = Path(numba.config.CACHE_DIR).glob("*/*.nbc")
    return sorted(
        path.name
        for path in compiled
        if not path.name.endswith(".1.nbc") and not path.parent.name.startswith("tests_")
    )


def _left_out(config):
    """Numbers of tests that were left out, by reason: of this process or of its workers."""
    return config.stash.get(LEFT_OUT, {}) or config.stash.get(LEFT_OUT_BY_WORKERS, {})


@pytest.hookimpl(optionalhook=True)
def pytest_sessionfinish(session):
    """A worker of pytest-xdist tells what it left out; all of them leave out the same.

    The whole run fails where a kernel was compiled for a second kind of arguments.
    """
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left_out"] = session.config.stash.get(LEFT_OUT, {})
    elif kernels_compiled_twice() and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    told = getattr(node, "workeroutput", {}).get("left_out", {})
    node.config.stash[LEFT_OUT_BY_WORKERS] = told


@pytest.fixture(autouse=True)
def logging_as_before():
    """What a test has a command configure ends with it: the stream that it writes to is closed."""
    root, service = logging.getLogger(), logging.getLogger("service")
    handlers, levels = list(root.handlers), (root.level, service.level)
    yield
    root.handlers[:] = [each for each in root.handlers if each in handlers] + [
        each for each in handlers if each not in root.handlers
    ]
    root.setLevel(levels[0])
    service.setLevel(levels[1])


@pytest.fixture(autouse=True, scope="module")
def memory_given_back():
    """What a file of tests freed goes back to the system; glibc would keep it in pieces."""
    yield
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)


@pytest.fixture(autouse=True)
def projections_waited_for(monkeypatch):
    """Readers wait for the projections as long as it takes, however busy the machine is."""
    monkeypatch.setattr(progress, "WAIT_S", 60.0)


@pytest.fixture
def seed(request):
    return request.config.getoption("--seed")


@pytest.fixture
def figures(seed, record_property):
    """Takes down how much was tried and what came of it: figures(kills=500); told at the end."""

    def note(**counted):
        # As JSON has it: a property may come from another process.
        record_property(FIGURES, json.loads(json.dumps(counted | {"seed": seed}, default=str)))

    return note


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


@pytest.fixture(scope="session")
def sky():
    """The embedded catalog with a shelf, shared by all tests: answers do not depend on it."""
    return SkyModel(load_embedded(), LruCache(max_bytes=160 << 20))


@pytest.fixture(scope="session")
def missions():
    return load_missions()


@pytest.fixture(scope="session")
def mission_files():
    """The shipped missions as plain dictionaries that state every value."""
    return {
        path.stem.upper(): tomllib.loads(path.read_text(encoding="utf-8"))
        for path in sorted(STATED_FOLDER.glob("*.toml"))
    }


@pytest.fixture(params=["sqlite", "postgresql"])
def empty_database(request, tmp_path):
    """The URL of a database with nothing in it."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'acquire.db'}"
        return
    with fresh_databases.postgresql_schema() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request, tmp_path, postgresql_schemas):
    """The URL of a database that is up to date."""
    if request.param == "sqlite":
        yield sqlite_at(tmp_path / "acquire.db")
        return
    with postgresql_schemas.fresh() as url:
        yield url


@pytest.fixture(scope="session")
def postgresql_schemas():
    """Gives the URLs of PostgreSQL schemas that are up to date: `with schemas.fresh() as url`."""
    schemas = fresh_databases.PostgresqlSchemas()
    yield schemas
    schemas.close()


@pytest.fixture(scope="session")
def postgresql_schema():
    """Makes the URL of an empty schema on PostgreSQL, as a context; skips without a server."""
    return fresh_databases.postgresql_schema


@pytest.fixture(scope="session")
def chosen_database(request, tmp_path_factory, postgresql_schemas):
    """Gives the URLs of databases of the kind that --database names, up to date."""
    with ExitStack() as schemas:

        def fresh():
            if request.config.getoption("--database") == "sqlite":
                return sqlite_at(tmp_path_factory.mktemp("chosen") / "acquire.db")
            return schemas.enter_context(postgresql_schemas.fresh())

        yield fresh


@pytest.fixture(scope="session")
def shared_service(chosen_database):
    """One service for all tests that ask for nothing but to add to its records."""
    # Its imports take seconds, which most tests need not wait for.
    from tests.web.serving import serving_in_process

    with serving_in_process(chosen_database()) as service:
        yield service


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """A browser for all tests; each module opens pages of its own in it."""
    from tests.web.browser import chromium

    with chromium(tmp_path_factory.mktemp("profile")) as socket:
        yield socket


@pytest.fixture(scope="module")
def browser(chromium):
    from tests.web.browser import Browser

    with Browser(chromium) as browser:
        yield browser


@pytest.fixture
def acquire(capsys, tmp_path, monkeypatch):
    """Run a command in an empty folder with nothing set; its exit code, output and complaints."""
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith("ACQUIRE_")]:
        monkeypatch.delenv(name)

    def run(*arguments):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = stop.code
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return run
