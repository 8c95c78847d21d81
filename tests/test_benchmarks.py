"""The benchmarks run, on small samples, and find everything within its bounds."""

from pathlib import Path

import pytest

from benchmarks import aberration, covariance
from benchmarks.__main__ import main
from benchmarks.verification import TARGET


@pytest.mark.parametrize("benchmark", [aberration, covariance])
def test_a_benchmark_s_small_sample_is_within_its_bounds(benchmark, seed):
    report = benchmark.run(quick=True, seed=seed)
    assert report.passed, report.text()


def test_a_benchmark_prints_its_figures(capsys):
    assert main(["zone_counts", "--quick"]) == 0
    assert "zone_counts: within bounds" in capsys.readouterr().out


def test_an_unknown_benchmark_is_refused_by_name(capsys):
    with pytest.raises(SystemExit):
        main(["zone_count"])
    assert "zone_count" in capsys.readouterr().err


def test_the_verification_document_names_the_command_that_writes_it():
    text = Path(TARGET).read_text(encoding="utf-8")
    assert "python -m benchmarks.verification" in text.splitlines()[2]
    assert "small samples" not in text.split("## The sky")[0]
    assert "out of bounds.**" not in text
