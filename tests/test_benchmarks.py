"""The benchmarks run, on small samples, and find everything within its bounds."""

from pathlib import Path

import pytest

from benchmarks import aberration, covariance, lost_in_space
from benchmarks.__main__ import main
from benchmarks.sections import Section, Written, kept
from benchmarks.verification import SECTIONS, TARGET, remake


@pytest.mark.parametrize("benchmark", [aberration, covariance])
def test_a_benchmark_s_small_sample_is_within_its_bounds(benchmark, seed):
    report = benchmark.run(quick=True, seed=seed)
    assert report.passed, report.text()


def test_a_benchmark_prints_its_figures(capsys):
    assert main(["zone_counts", "--quick"]) == 0
    assert "zone_counts: within bounds" in capsys.readouterr().out


def test_the_solvers_benchmark_explains_itself(capsys):
    """Its conditions have percent signs in their names."""
    with pytest.raises(SystemExit) as stopped:
        lost_in_space.main(["--help"])
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
    """Each section carries its own seed; the verdict of the page is that of all its sections."""
    drawn = {"figure": "earliest"}

    def write(quick, seed):
        passed = drawn["figure"] != "bad"
        return Written(f"The {drawn['figure']} figure.", passed, {"one.svg": drawn["figure"]})

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
    assert (tmp_path / "plots" / "one.svg").read_text("utf-8") == "bad"
    drawn["figure"] = "second"
    assert remake(["one"], True, seed, page)
    assert "Everything is within its bounds." in page.read_text("utf-8")
