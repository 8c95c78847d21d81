"""Tests that all benchmarks run on small samples, and are within their bounds."""

import json
import re
from pathlib import Path

import pytest

from benchmarks.__main__ import main
from benchmarks.bounds import equal, share_as_expected
from benchmarks.record import ROOT, digest_of, read_record
from benchmarks.sections import Section, Written, bounds_shown, kept, stale, state_of
from benchmarks.speed import live_filter, performance, tracker_calibration
from benchmarks.speed.fleet_year import number_text, year
from benchmarks.speed.scale import size_text
from benchmarks.validation import aberration, centroids, consistency, covariance, tracker_sigmas
from benchmarks.validation.imaging_claims import HELD_AGAINST
from benchmarks.validation.lost_in_space.__main__ import main as lost_in_space
from benchmarks.validation.lost_in_space.conditions import CONDITIONS
from benchmarks.validation.lost_in_space.document import LEAST_RIGHT
from benchmarks.verification import SECTIONS, TARGET, remake
from benchmarks.verification import main as verification
from service.missions.mission import load_missions


@pytest.mark.parametrize(
    "benchmark",
    [
        *(aberration, tracker_calibration, tracker_sigmas),
        *(pytest.param(each, marks=pytest.mark.slow) for each in (consistency, covariance)),
    ],
)
def test_a_benchmark_s_small_sample_is_within_its_bounds(benchmark, seed):
    report = benchmark.run(quick=True, seed=seed)
    assert report.passed, report.text()


def test_centroids_are_held_beside_photutils_and_sep(monkeypatch, seed):
    monkeypatch.setattr(centroids, "RATIOS", (100.0,))
    report = centroids.run(quick=True, seed=seed)
    assert report.passed, report.text()
    assert "sep winpos" in report.text()


def test_the_mission_of_the_live_filter_differs_from_the_shipped_one_in_that_filter_alone(tmp_path):
    """The service without the filter uses the shipped mission."""
    mission = live_filter.mission_in(tmp_path)
    assert mission.live_filter is not None
    assert mission.model_copy(update={"live_filter": None}) == load_missions()["XTE"]


def test_the_tests_that_the_page_on_star_images_names_are_there():
    for _, _, file, test in HELD_AGAINST:
        assert f"def {test}(" in (ROOT / "tests" / file).read_text(encoding="utf-8")


def test_a_benchmark_prints_its_figures(capsys):
    assert main(["zone_counts", "--quick"]) == 0
    assert "zone_counts: within bounds" in capsys.readouterr().out


def test_the_solvers_benchmark_explains_itself(capsys):
    """The names of conditions contain percent signs, which argparse would interpret."""
    with pytest.raises(SystemExit) as stopped:
        lost_in_space(["--help"])
    assert stopped.value.code == 0
    assert "focal length off 0.2 %" in capsys.readouterr().out


def test_an_unknown_benchmark_is_refused_by_name(capsys):
    with pytest.raises(SystemExit):
        main(["zone_count"])
    assert "zone_count" in capsys.readouterr().err


def test_the_verification_document_names_the_command_that_writes_it():
    text = Path(TARGET).read_text(encoding="utf-8")
    assert "python -m benchmarks.verification" in text.splitlines()[2]
    assert "Everything is within its bounds." in text


def test_the_verification_document_holds_every_section_at_full_size():
    sections = kept(Path(TARGET).read_text(encoding="utf-8"))
    assert list(sections) == list(SECTIONS)
    for text in sections.values():
        assert "full size; within bounds" in text.splitlines()[0]


def test_one_section_is_made_anew_and_the_others_are_kept(tmp_path, monkeypatch, seed):
    """Each section has its own seed; the verdict of the page covers all its sections."""
    drawn = {"figure": "earliest"}

    def write(quick, seed):
        bounds = [equal("bad figures", int(drawn["figure"] == "bad"), 0)]
        return Written(f"The {drawn['figure']} figure.", bounds, {"one.svg": drawn["figure"]})

    monkeypatch.setitem(SECTIONS, "one", Section("One", write))
    page = tmp_path / "page.md"
    assert remake(["sky", "one"], True, seed, page)
    sky = kept(page.read_text("utf-8"))["sky"]
    drawn["figure"] = "bad"
    assert not remake(["one"], False, seed + 1, page)
    text = page.read_text("utf-8")
    assert kept(text)["sky"] == sky
    assert "The bad figure." in text
    assert "The earliest figure." not in text
    assert f"section one; seed {seed + 1}; full size; out of bounds" in text
    assert "**Out of bounds: one.**" in text
    assert "| bad figures | 1 | 0 | **does not hold** |" in text
    assert (tmp_path / "plots" / "one.svg").read_text("utf-8") == "bad"
    drawn["figure"] = "second"
    assert remake(["one"], True, seed, page)
    assert "Everything is within its bounds." in page.read_text("utf-8")


def test_every_condition_of_lost_in_space_with_an_answer_has_a_bound():
    for name, condition in CONDITIONS.items():
        assert not condition.real or name in LEAST_RIGHT, name


def test_a_section_without_bounds_is_not_within_its_bounds():
    assert not Written("A figure that nothing was held against.", []).passed


def test_a_section_is_stale_once_its_sources_have_changed(tmp_path, monkeypatch, seed):
    source = tmp_path / "source.py"
    source.write_text("FACTOR = 1\n", "utf-8")

    def write(quick, seed):
        return Written("A figure.", [equal("figures", 1, 1)])

    section = Section("One", write, (str(source),))
    monkeypatch.setitem(SECTIONS, "one", section)
    page = tmp_path / "page.md"
    remake(["one"], False, seed, page)

    def found():
        return stale(kept(page.read_text("utf-8")), {"one": section})

    assert found() == []
    source.write_text("FACTOR = 2\n", "utf-8")
    (why,) = found()
    assert "one: measured at commit" in why
    assert "its sources have changed" in why
    remake(["one"], False, seed, page)
    assert found() == []


def test_a_source_that_is_left_out_makes_nothing_stale(tmp_path):
    kept, apart = tmp_path / "kept.py", tmp_path / "apart.py"
    for file in (kept, apart):
        file.write_text("FACTOR = 1\n", "utf-8")
    sources = (str(tmp_path), f":!{apart}")
    first = digest_of(sources)
    apart.write_text("FACTOR = 2\n", "utf-8")
    assert digest_of(sources) == first
    kept.write_text("FACTOR = 2\n", "utf-8")
    assert digest_of(sources) != first


def test_a_section_without_its_record_is_stale():
    page = (
        "<!-- section one; seed 1; full size; within bounds -->\nA figure.\n<!-- end of one -->\n"
    )
    (why,) = stale(kept(page), {"one": SECTIONS["sky"]})
    assert why.startswith("one: no record")


def test_the_check_exits_with_one_exactly_where_it_names_a_stale_section(capsys, tmp_path):
    assert verification(["--check", "--output", str(tmp_path / "no page.md")]) == 1
    printed = capsys.readouterr().out
    for name in SECTIONS:
        assert f"no page.md: {name}: no record" in printed
    assert verification(["--check"]) == (capsys.readouterr().out != "no section is stale\n")


@pytest.mark.parametrize(
    ("hits", "of", "holds"),
    [(2, 2_000, True), (10, 2_000, False), (20, 20_000, True), (1, 20_000, False)],
)
def test_a_share_is_held_against_its_probability_on_both_sides(hits, of, holds):
    """Five times the expected number of suspect attitudes is out of bounds, and so are too few."""
    assert share_as_expected("suspect", hits, of, 0.001).holds is holds


def test_every_section_of_the_verification_has_its_record_and_its_bounds():
    for name, text in kept(Path(TARGET).read_text(encoding="utf-8")).items():
        state, record = state_of(text)
        assert state == "within bounds", name
        assert record is not None, name
        assert "dirty" not in record.commit, name
        assert bounds_shown(text) > 0, name


def test_every_benchmark_of_speed_has_its_record_and_its_bounds():
    results = json.loads(performance.RESULTS.read_text("utf-8"))["benchmarks"]
    for name in performance.TITLES:
        assert read_record(results[name].get("code", "")) is not None, name
        assert results[name]["bounds"], name


def test_the_table_of_fleets_has_no_exponents():
    text = year({"SQLite": 2_380.0, "PostgreSQL": 4_969.0, "the archive": 739.0}, 1_585.0)
    assert not re.search(r"\de[+-]\d", text)
    assert "| 1 | one in 5 minutes | 105,000 | 0.00333 |" in text
    assert "| 315,000,000,000 | 10,000 | 6.3 services' posts | 751 TB | 1.57 PB | 233 TB |" in text
    assert [number_text(number) for number in (999.4, 999.6, 1e3)] == ["999", "1,000", "1,000"]
    assert [size_text(size) for size in (9.994e11, 9.996e11)] == ["999 GB", "1 TB"]
