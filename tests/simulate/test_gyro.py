"""A gyro beside a drawn pass: it measures the turns between the true attitudes."""

import itertools
import json

import numpy as np
import pytest

from service.cli import main
from service.errors import BadInput
from service.gyro.blocks import block_from_line
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import GyroWanted, draw_pass, read_objects, with_gyro, write_pass
from service.times import parse_utc
from service.vectors import ARCSEC_PER_RADIAN, rotation_vectors, turned_quaternion
from tests.features.definitive.passes import mission_with
from tests.missions.without_gyro import mission_without_gyro, text_without_gyro

QUIET = {"sigma_v_rad_s0_5": 0.0, "sigma_u_rad_s1_5": 0.0, "bias_sigma_rad_s": 1e-30}
NOISY = {"sigma_v_rad_s0_5": 1e-5, "sigma_u_rad_s1_5": 1e-7}
N, CADENCE_S = 12, 30.0


def drawn(missions, sky, gyro, wanted=None, **told):
    mission = mission_with(missions["XTE"], gyro=gyro)
    asked = Pass(N, 3, troubles=NO_TROUBLES)
    batches = draw_pass(mission, sky, asked)
    return list(with_gyro(batches, mission, wanted or GyroWanted(**told), (N - 1) * CADENCE_S, 3))


def blocks_of(passes):
    return [block_from_line(json.dumps(each)) for one in passes for each in one.gyro]


def samples_of(passes):
    blocks = blocks_of(passes)
    times = np.concatenate([each.tai_ns for each in blocks])
    return times, np.concatenate([each.rates_rad_per_s for each in blocks])


def test_without_errors_the_samples_lead_from_each_attitude_to_the_next(missions, sky):
    passes = drawn(missions, sky, QUIET, step_s=1.0)
    times, rates = samples_of(passes)
    assert len(times) == (N - 1) * CADENCE_S + 1
    assert set(np.diff(times)) == {10**9}
    for before, after in itertools.pairwise(passes):
        ends = [parse_utc(each.truth["time"]).tai_ns for each in (before, after)]
        q = np.array(before.truth["quaternion"])
        for rate in rates[(times > ends[0]) & (times <= ends[1])]:
            q = turned_quaternion(q, rate)
        error = rotation_vectors(q, np.array(after.truth["quaternion"])) * ARCSEC_PER_RADIAN
        assert np.abs(error).max() < 1e-4


def test_axes_are_those_of_the_mission(missions, sky):
    _, plain = samples_of(drawn(missions, sky, QUIET, step_s=1.0))
    _, turned = samples_of(drawn(missions, sky, QUIET | {"axes": ["-Y", "Z", "X"]}, step_s=1.0))
    np.testing.assert_allclose(turned, plain[:, [1, 2, 0]] * [-1.0, 1.0, 1.0], atol=2e-12)


def test_noise_bias_and_scale_are_those_of_the_mission(missions, sky):
    _, plain = samples_of(drawn(missions, sky, QUIET, step_s=0.25))
    _, noisy = samples_of(drawn(missions, sky, QUIET | {"sigma_v_rad_s0_5": 1e-5}, step_s=0.25))
    noise = noisy - plain
    assert noise.std() == pytest.approx(1e-5 / 0.5, rel=0.05)
    assert abs(noise.mean()) < 5 * 2e-5 / noise.size**0.5
    _, biased = samples_of(drawn(missions, sky, QUIET | {"bias_sigma_rad_s": 1e-4}, step_s=0.25))
    bias = (biased - plain)[0]
    assert 1e-6 < np.abs(bias).max() < 5e-4
    np.testing.assert_allclose(biased - plain, np.tile(bias, (len(plain), 1)), atol=3e-12)
    _, scaled = samples_of(drawn(missions, sky, QUIET | {"scale": 0.01}, step_s=0.25))
    fast = np.abs(plain) > 1e-4
    share = (scaled[fast] / plain[fast]) - 1.0
    assert 1e-4 < np.abs(share).max() < 0.05


def test_a_count_is_never_lost(missions, sky):
    _, plain = samples_of(drawn(missions, sky, QUIET, step_s=1.0))
    _, counted = samples_of(drawn(missions, sky, QUIET, step_s=1.0, quantum_arcsec=5.0))
    counts = counted * ARCSEC_PER_RADIAN / 5.0
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    apart = np.cumsum(counted - plain, axis=0) * ARCSEC_PER_RADIAN
    assert np.abs(apart).max() <= 5.0 + 1e-3


def test_a_gap_and_a_step_of_the_clock_are_where_they_are_asked_for(missions, sky):
    passes = drawn(missions, sky, NOISY, step_s=1.0, gap_s=60.0, clock_step_s=2.0)
    times, _ = samples_of(passes)
    start = parse_utc(passes[0].truth["time"]).tai_ns
    steps = np.diff(times) * 1e-9
    (gap,) = np.flatnonzero(steps > 50.0)
    assert (times[gap] - start) * 1e-9 == pytest.approx(132.0)
    (step,) = np.flatnonzero((steps > 1.5) & (steps < 50.0))
    assert (times[step + 1] - start) * 1e-9 == pytest.approx(231.0 + 2.0)
    sent = [parse_utc(each.batch["time"]).tai_ns for each in passes]
    assert sorted(set(np.diff(sent))) == [30 * 10**9, 32 * 10**9]
    assert [each.batch["time"] for each in passes] == [each.truth["time"] for each in passes]


def test_the_same_seed_gives_the_same_gyro(missions, sky):
    one, two = (samples_of(drawn(missions, sky, NOISY, step_s=1.0)) for _ in range(2))
    np.testing.assert_array_equal(one[1], two[1])


def test_blocks_stand_in_the_file_after_their_batches(missions, sky, tmp_path):
    passes = drawn(missions, sky, NOISY, step_s=0.1)
    assert write_pass(passes, tmp_path / "pass.ndjson") == N
    lines = list(read_objects(tmp_path / "pass.ndjson"))
    assert [("block" in line) for line in lines].count(True) == 4
    assert [line for line in lines if "batch" in line] == [each.batch for each in passes]


def test_a_mission_without_a_gyro_is_refused(sky, tmp_path, monkeypatch, capsys):
    mission = mission_without_gyro("XTE")
    batches = draw_pass(mission, sky, Pass(1, 3))
    with pytest.raises(BadInput, match=r"gyro: its mission file has no table \[gyro\]"):
        list(with_gyro(batches, mission, GyroWanted(), 1.0, 3))
    (tmp_path / "xte.toml").write_text(text_without_gyro("XTE"), encoding="utf-8")
    monkeypatch.setenv("ACQUIRE_MISSIONS", str(tmp_path))
    asked = ["--spacecraft", "XTE", "--batches", "2", "--gyro", "1", str(tmp_path / "out.ndjson")]
    assert main(["simulate", "telemetry", *asked]) == 2
    assert "its mission file has no table [gyro]" in capsys.readouterr().err
    assert not (tmp_path / "out.ndjson").exists()


@pytest.mark.parametrize("spacecraft", ["XTE", "SWAS", "SOHO"])
def test_the_shipped_missions_have_a_gyro_to_simulate(spacecraft, tmp_path):
    asked = ["--spacecraft", spacecraft, "--batches", "3", "--gyro", "1"]
    assert main(["simulate", "telemetry", *asked, str(tmp_path / "out.ndjson")]) == 0
    (block,) = [each for each in read_objects(tmp_path / "out.ndjson") if "block" in each]
    assert block["spacecraft"] == spacecraft
    assert len(block["rates_rad_per_s"]) in (61, 601)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--gyro 0.001 out.ndjson", "gyro step_s: must be from 0.01 to 3600"),
        ("--gyro 1 --gyro-gap -1 out.ndjson", "gyro gap_s: must be from 0 to 86400"),
        ("--gyro 1 out.csv", "--gyro: needs NDJSON"),
        ("--clock-step 1 out.ndjson", "--gyro: is missing"),
    ],
)
def test_what_cannot_be_is_refused(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    asked = ["simulate", "telemetry", "--spacecraft", "XTE", "--batches", "2", *words.split()]
    assert main(asked) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
