"""The demonstration: from nothing to a table against truth, the same the second time."""

import hashlib
import json
import random
import re
import signal
import socket
import subprocess
import sys
from itertools import takewhile
from pathlib import Path

import httpx
import numba
import pytest

from service import demo as demonstration
from service.acquire.kernel_build import KERNEL_BYTES, mark_built
from service.cli import main
from service.demo import MISSIONS
from service.settings import Settings
from service.simulate.score import Score, score, score_table
from service.simulate.telemetry import read_objects, truth_path
from tests.scale import draws, is_full

BATCHES = draws(100, 300)
"""Of each mission, a fifth of them with serious trouble; 300 unless it is told otherwise."""
SAMPLES = 7_200 * (BATCHES - 1) // BATCHES + 1
"""Of the gyro beside a pass, every 10 s from the first batch to the last."""
LAST_MIN = 20 * 60 * (BATCHES - 1) // BATCHES
NAMED_PORTS = range(20_000, 32_000)
"""Below those that outgoing connections are given."""
TAKEN = "Address already in use"


def a_port():
    """A port that a server will have to itself, unless another process takes it meanwhile."""
    return str(random.choice(NAMED_PORTS))


class Demonstration:
    """`acquire demo` in a process that ignores SIGINT, as one that a script starts with & does.

    It serves until it is told to stop by a signal.
    """

    def __init__(self, folder, told, ignored, *arguments):
        self.folder, self.port = folder, a_port()
        command = [sys.executable, "-m", "service.cli", "demo", "--folder", str(folder)]
        command += ["--port", self.port, *map(str, arguments)]
        trap = "trap '' INT" if ignored else "trap - INT"
        command = ["sh", "-c", f'{trap}; exec "$@"', "sh", *command]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        with subprocess.Popen(command, **pipes) as running:
            lines = iter(running.stdout.readline, "")
            ready = f"Serving on http://127.0.0.1:{self.port} until Ctrl-C.\n"
            self.told = "".join(takewhile(lambda line: line != ready, lines))
            try:
                self.live = running.poll() is None and self.is_live()
                running.send_signal(told)
                self.last_words, self.complaints = running.communicate(timeout=60)
            finally:
                running.kill()
        self.exit_code = running.returncode

    def is_live(self):
        address = f"http://127.0.0.1:{self.port}/livez"
        return httpx.get(address, trust_env=False).status_code == 200

    @property
    def run(self):
        return re.search(r"run=(demo-\w+)", self.told)[1]


def demonstration_of(folder, told, ignored, *arguments):
    """Another one, where its port was taken."""
    while TAKEN in (done := Demonstration(folder, told, ignored, *arguments)).complaints:
        pass
    return done


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The demonstration as a newcomer runs it."""
    options = () if is_full() else ("--batches", BATCHES)
    return demonstration_of(tmp_path_factory.mktemp("demo"), signal.SIGINT, True, *options)


@pytest.fixture
def demo(acquire):
    """Runs `acquire demo --once` in this process; its exit code, output and complaints."""

    def run(folder, *arguments):
        done = acquire("demo", "--folder", folder, "--once", "--port", a_port(), *arguments)
        return run(folder, *arguments) if TAKEN in done[2] else done

    return run


def rows(printed):
    """The numbers of the table by mission and stretch."""
    lines = [line.split() for line in printed.splitlines() if re.match(r"[A-Z]+ (nom|ser)", line)]
    return {(name, stretch): [float(each) for each in numbers] for name, stretch, *numbers in lines}


def assert_as_predicted(printed, folder, least_within=98.0):
    """Misidentified at most 0.1 %, unique at least 99 %: over all three missions."""
    found = rows(printed)
    assert list(found) == [(name, kind) for name in MISSIONS for kind in ("nominal", "serious")]
    nominal = [found[name, "nominal"] for name in MISSIONS]
    stars = sum(each[1] for each in nominal)
    assert sum(each[1] * each[2] for each in nominal) / stars >= 99.0
    assert sum(each[1] * each[5] for each in nominal) / stars <= 0.1
    for batches, _, _, _, _, _, attitudes, error, sigma, within, *_ in nominal:
        assert batches == BATCHES * 4 // 5
        assert attitudes >= 0.98 * batches
        assert error == pytest.approx(sigma, rel=0.35)
        assert within >= least_within
    # What the table says is what the files say.
    for name in MISSIONS:
        results = list(read_objects(folder / f"{name.lower()}.results.ndjson"))
        truths = list(read_objects(truth_path(folder / f"{name.lower()}.ndjson")))
        # Beside the batches there are gyro blocks of a thousand samples.
        blocks = [each for each in results if "block" in each]
        assert [each["samples"] for each in blocks] == [1000] * 7 + [SAMPLES - 7_000]
        results = [each for each in results if "block" not in each]
        assert len(results) == len(truths) == BATCHES
        counted = score(results, truths)["nominal"]
        assert counted.percent("unique") == pytest.approx(found[name, "nominal"][2], abs=0.006)


def test_nominal_stretches_are_identified_and_the_errors_are_as_predicted(first, capsys):
    assert first.live, first.complaints
    assert f"samples, answers and database: {first.folder}" in first.complaints
    assert_as_predicted(first.told, first.folder)
    # The passes can be filtered with their gyros as they are.
    (words,) = re.findall(r"acquire (smooth XTE --run .*)$", first.told, re.MULTILINE)
    assert main([*words.split(), "--quiet"]) == 0
    last = f"{LAST_MIN // 60}:{LAST_MIN % 60:02d}:00.000Z"
    assert f"{last}: gyro, {SAMPLES} samples" in capsys.readouterr().out


@pytest.mark.slow
def test_so_they_are_with_other_samples(tmp_path, seed, demo):
    code, told, complaints = demo(tmp_path / "demo", "--seed", seed, "--batches", BATCHES)
    assert code == 0, complaints
    # Of 240 attitudes one is expected outside, five come once in four hundred seeds.
    assert_as_predicted(told, tmp_path / "demo", least_within=97.0)


def test_it_keeps_serving_until_it_is_told_to_stop_and_takes_its_server_with_it(first):
    assert_served_and_stopped(first)


def assert_served_and_stopped(done):
    assert done.live, (done.told, done.complaints)
    assert "curl -s 'http://127.0.0.1:" in done.told
    assert (done.last_words, done.exit_code) == ("stopped\n", 0)
    with pytest.raises(httpx.ConnectError):
        done.is_live()


@pytest.mark.slow
@pytest.mark.parametrize("ignored", [False, True])
@pytest.mark.parametrize("told", [signal.SIGINT, signal.SIGTERM])
def test_each_signal_stops_it(tmp_path, told, ignored):
    """Also where it has come to ignore SIGINT by being started in the background."""
    assert_served_and_stopped(demonstration_of(tmp_path, told, ignored, "--batches", 3))


@pytest.mark.slow
def test_a_second_time_nothing_is_new_and_the_figures_are_the_same_as_json_too(first, demo):
    code, printed, complaints = demo(first.folder, "--batches", BATCHES, "--json")
    assert code == 0, complaints
    told = json.loads(printed)
    assert told["run"] == first.run
    found = {(row["spacecraft"], row["kind"]): row for row in told["scores"]}
    shown = rows(first.told)
    assert found.keys() == shown.keys()
    names = ("batches", "stars", "unique_percent", "ambiguous_percent", "unmatched_percent")
    names += ("wrong_percent", "attitudes", "error_arcsec", "sigma_arcsec", "within_percent")
    for key, row in found.items():
        # The table has two digits of what the figures are.
        assert [row[name] for name in names] == pytest.approx(shown[key][: len(names)], abs=0.006)


def test_all_missions_fly_on_the_day_that_the_console_shows_first(first):
    times = [
        [
            each["time"]
            for each in read_objects(first.folder / f"{name.lower()}.ndjson")
            if "block" not in each
        ]
        for name in MISSIONS
    ]
    assert times[0] == times[1] == times[2]
    assert times[0][0][:10] == times[0][-1][:10]


def test_when_nothing_serves_any_more_the_way_to_the_records_comes_before_their_address(
    tmp_path, monkeypatch
):
    told = dict(demonstration._where_next("http://h:1", "demo-1", Path("f"), Settings(), True))
    places = [place.strip() for place in told]
    serve, page = (f"acquire serve --database {Settings().database}", "http://h:1/?run=demo-1")
    assert places.index(serve) < places.index(page)
    assert not [each for each in places if each.startswith("curl")]
    assert "docs/quickstart.md" in places
    # A wheel has no documents.
    monkeypatch.setattr(demonstration, "shipped", lambda *parts: tmp_path.joinpath(*parts))
    told = dict(demonstration._where_next("http://h:1", "demo-1", Path("f"), Settings(), True))
    assert not [place for place in told if place.startswith("docs/")]


@pytest.mark.slow
def test_other_samples_go_into_a_run_of_their_own_and_the_same_do_not(tmp_path, demo):
    words = ("--batches", 12)
    first, second, other = (
        demo(tmp_path / "demo", *words, *more) for more in ((), (), ("--seed", 2))
    )
    assert [each[0] for each in (first, second, other)] == [0, 0, 0]
    assert rows(first[1]) == rows(second[1]) != {}
    assert rows(other[1]) != rows(first[1])
    assert first[1].index("acquire serve --database") < first[1].index("/?run=demo-")
    assert "curl" not in first[1]


def test_a_long_start_is_told_on_a_moving_line_or_now_and_then(monkeypatch, capsys, tmp_path):
    # A cache in which compiling has begun.
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    (tmp_path / "hypotheses_1").mkdir()
    content = bytes(KERNEL_BYTES // 4 - hashlib.sha256().digest_size)
    whole = hashlib.sha256(content).digest() + content
    (tmp_path / "hypotheses_1" / "search.1.nbc").write_bytes(whole)

    def said(terminal):
        monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
        with demonstration._Waiting() as waiting:
            for waited_s in (0.0, 1.0, 6.0, 7.0, 16.0):
                waiting.show(waited_s)
        return capsys.readouterr().err

    assert said(False).count("\n") == 2
    moving = said(True)
    assert "\n" not in moving
    assert moving.count("the server is starting") == 5
    assert moving.count("first start compiles") == 3
    # A quarter is done after 16 s: step, share and time left.
    assert "compiling kernels, verified identification: 25 %, about 48 s left" in moving
    mark_built()
    assert "compil" not in said(True)
    assert moving.endswith(" \r")


def test_a_port_that_is_taken_is_said_at_once(acquire, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        code, _, complaint = acquire("demo", "--folder", tmp_path, "--port", port)
    assert code == 2
    assert f"acquire: http://127.0.0.1:{port}: {TAKEN}" in complaint
    assert "--port" in complaint


def test_a_score_counts_wrong_names_and_compares_errors_with_their_sigma():
    """A hand-made answer: two right, one wrong, one spurious star named, the attitude exact."""
    right = {"outcome": "unique", "star": {"catalog": "HIP", "id": "HIP 1"}}
    unsure = {"outcome": "ambiguous", "star": None}
    attitude = {
        "quaternion": [0.0, 0.0, 0.0, 1.0],
        "covariance_arcsec2": [[100.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]],
    }
    answer = {
        "observations": [{"tracker": "A", "stars": [right, right, right, right, unsure]}],
        "timings_us": {"zone": 1, "identify": 2, "solve": 3, "record": None},
        "attitude": attitude,
    }
    half_turn = 10.0 / 3600.0 * 3.141592653589793 / 360.0
    truth = {
        "stretch": "nominal",
        "observations": [{"tracker": "A", "stars": ["HIP 1", "HIP 1", "HIP 2", None, "HIP 3"]}],
        "quaternion": [half_turn, 0.0, 0.0, 1.0],
    }
    found = score([answer, {"line": 2, "problem": {}}], [truth, truth])["nominal"]
    assert dict(found.stars) == {"observed": 5, "unique": 4, "ambiguous": 1, "wrong": 2}
    assert (found.batches, found.refused, found.attitudes) == (1, 1, 1)
    assert found.chi_square == [pytest.approx(1.0)]
    assert found.predicted_sigma_arcsec == pytest.approx(10.0)
    assert found.seen_sigma_arcsec == pytest.approx(10.0 / 0.6745)
    assert (found.within_percent, found.median_solving_us, found.median_whole_us) == (100, 5, 6)


@pytest.mark.parametrize(
    ("feature", "command"), [("definitive", "acquire smooth"), ("pictures", "acquire frame")]
)
def test_it_names_no_command_of_a_feature_that_is_off(tmp_path, feature, command):
    for off, is_named in (("", True), (feature, False)):
        settings = Settings(features_off=off)
        rows = demonstration._where_next("http://127.0.0.1:8000", "r", tmp_path, settings, False)
        assert any(row.startswith(command) for row, _ in rows) is is_named


def test_a_pass_without_stars_has_a_table_all_the_same():
    assert "nan" in score_table({"XTE": {"nominal": Score()}})
