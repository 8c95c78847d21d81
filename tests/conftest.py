"""What every test may ask for: one seed, the embedded sky, the shipped missions.

pytest --seed 7           other random draws, for hypothesis as well
pytest --batches 2000     batches per mission held against the plain implementation
pytest --database postgresql tests/web     the interface and its pages over PostgreSQL
pytest --torture          tests of kills, failing disks and odd input at full size, not a fiftieth

Every test that asks for `database` runs on SQLite and on PostgreSQL, which takes
part where TEST_POSTGRESQL_URL names a database to be used for tests; each test has
a schema of its own there.
"""

import faulthandler
import json
import logging
import os
import tomllib
import uuid
from contextlib import ExitStack, contextmanager

import hypothesis
import numpy as np
import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key
from sqlalchemy import create_engine, make_url, text

from service.cli import main
from service.missions.mission import SHIPPED_FOLDER, load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.sql.engines import database_url
from service.storage.sql.migrations import upgrade
from tests import scale
from tests.torture import FIGURES

DEFAULT_SEED = 19941026
DEFAULT_BATCHES = 240
TORTURE_TIMEOUT_S = 6 * 3600

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
        default=int(os.environ.get("TEST_BATCHES", DEFAULT_BATCHES)),
        help="batches per mission held against the plain implementation",
    )
    parser.addoption(
        "--database",
        choices=("sqlite", "postgresql"),
        default="sqlite",
        help="what the tests of pages and of the interface keep their records in",
    )
    parser.addoption(
        "--torture", action="store_true", help="kills, failing disks, odd input: at full size"
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config):
    if config.getoption("--torture"):
        os.environ.setdefault(scale.VARIABLE, "1")
    seed = config.getoption("--seed")
    if seed == DEFAULT_SEED:
        hypothesis.settings.load_profile("repeatable")
    else:
        hypothesis.settings.load_profile("seeded")
        hypothesis.core.global_force_seed = seed


def pytest_collection_modifyitems(config, items):
    """With a --database of their own choice, only tests that keep something in it."""
    if config.getoption("--database") == "sqlite":
        return
    chosen = [item for item in items if "chosen_database" in item.fixturenames]
    others = [item for item in items if "chosen_database" not in item.fixturenames]
    config.hook.pytest_deselected(items=others)
    items[:] = chosen


def pytest_runtest_setup(item):
    """Hours, not the minutes of `faulthandler_timeout`, before a torture counts as hanging."""
    if item.config.getoption("--torture") and item.get_closest_marker("torture"):
        stderr = item.config.stash[fault_handler_stderr_fd_key]
        faulthandler.dump_traceback_later(TORTURE_TIMEOUT_S, exit=True, file=stderr)


def pytest_terminal_summary(terminalreporter):
    """What tests of endurance did, a line each."""
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
    return SkyModel(load_embedded(), LruCache(max_bytes=256 << 20))


@pytest.fixture(scope="session")
def missions():
    return load_missions()


@pytest.fixture(scope="session")
def mission_files():
    """The shipped mission files as plain dictionaries."""
    return {
        path.stem.upper(): tomllib.loads(path.read_text(encoding="utf-8"))
        for path in sorted(SHIPPED_FOLDER.glob("*.toml"))
    }


@pytest.fixture(params=["sqlite", "postgresql"])
def empty_database(request, tmp_path):
    """The URL of a database with nothing in it."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'acquire.db'}"
        return
    with _postgresql_schema() as url:
        yield url


@pytest.fixture(scope="session")
def chosen_database(request, tmp_path_factory):
    """Gives the URLs of databases of the kind that --database names, up to date."""
    with ExitStack() as schemas:

        def fresh():
            if request.config.getoption("--database") == "sqlite":
                return f"sqlite:///{tmp_path_factory.mktemp('chosen') / 'acquire.db'}"
            url = schemas.enter_context(_postgresql_schema())
            upgrade(url)
            return url

        yield fresh


@pytest.fixture(scope="session")
def postgresql_schema():
    """Makes the URL of a schema of its own on PostgreSQL, as a context; skips without a server."""
    return _postgresql_schema


@contextmanager
def _postgresql_schema():
    """A schema of its own; skips where no server is named, for SQLite needs none. CI names one."""
    server = os.environ.get("TEST_POSTGRESQL_URL")
    if not server:
        pytest.skip("TEST_POSTGRESQL_URL names no PostgreSQL database to test on")
    schema = f"test_{uuid.uuid4().hex}"
    engine = create_engine(database_url(server), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE SCHEMA {schema}"))
        # The server itself is never killed here: its commits need not wait for the disk.
        options = f"-csearch_path={schema} -csynchronous_commit=off"
        url = make_url(server).update_query_dict({"options": options})
        yield url.render_as_string(hide_password=False)
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))
    engine.dispose()


@pytest.fixture
def database(empty_database):
    """The URL of a database that is up to date."""
    upgrade(empty_database)
    return empty_database


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
