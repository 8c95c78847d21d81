"""`acquire simulate imaging`: every claim of the report is held, printed and drawn."""

import io
import json

import pytest

from service.errors import BadInput
from studies.star_image_report.claims import Claim, Row, Study
from studies.star_image_report.command import ROWS, as_json, run_imaging, table


@pytest.fixture(scope="module")
def rows(request):
    """Every row, measured once on small samples."""
    study = Study(request.config.getoption("--seed"), quick=True)
    return {name: make(study) for name, make in ROWS.items()}


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.slow("IM-1")
def test_every_claim_of_a_row_is_within_its_bounds(name, rows):
    assert rows[name].name == name
    assert rows[name].claims
    for claim in rows[name].claims:
        assert claim.holds, f"{claim.says}: {claim.ours}"


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.slow("IM-1")
def test_the_claims_in_json_are_those_of_the_text(name, rows):
    text, claims = table(rows[name]), json.loads(as_json([rows[name]]))
    assert [claim["row"] for claim in claims] == [name] * len(rows[name].claims)
    for claim in claims:
        cells = (claim[key].replace("|", "\\|") for key in ("section", "report", "here"))
        assert "| {} | {} | {} | ".format(*cells) in text


def test_the_slips_of_the_report_are_told_as_corrected(rows):
    """Missing 1/(lambda f)², C of 4.1, rank 3, P to zero, factor 2, sign, background, variance."""
    corrected = {
        (row.name, claim.section)
        for row in rows.values()
        for claim in row.claims
        if claim.verdict == "corrected"
    }
    assert corrected >= {
        ("IM-1", "2.9"),
        ("IM-4", "4.1"),
        ("IM-7", "6.2"),
        ("IM-7", "6.4"),
        ("IM-7", "6.21"),
        ("IM-8", "7.4 to 7.6, 7.17 to 7.22"),
        ("IM-8", "7.2"),
        ("IM-10", "7.36"),
    }


def test_a_claim_out_of_its_bounds_shows(monkeypatch):
    off = Row("IM-5", "Sun", (Claim("5.3", "bright", "dark", "confirmed", holds=False),))
    monkeypatch.setitem(ROWS, "IM-5", lambda study: off)
    out = io.StringIO()
    assert not run_imaging(["IM-5"], out=out)[0].holds
    assert "**confirmed: out of bounds**" in out.getvalue()


def test_one_row_is_printed_written_and_drawn(tmp_path):
    report, claims = tmp_path / "page.md", tmp_path / "claims.json"
    run_imaging(
        ["im-5", "IM-6"],
        quick=True,
        json_path=claims,
        plots_folder=tmp_path / "plots",
        report_path=report,
        out=io.StringIO(),
    )
    text = report.read_text("utf-8")
    assert "## IM-5 Sun tracker" in text
    assert "## IM-4" not in text
    for name in ("imaging-sun", "imaging-negative"):
        assert f"](plots/{name}.svg)" in text
        assert (tmp_path / "plots" / f"{name}.svg").read_text("utf-8").startswith("<?xml")
    told = json.loads(claims.read_text("utf-8"))
    assert {claim["row"] for claim in told} == {"IM-5", "IM-6"}
    for claim in told:
        cells = (claim[each].replace("|", "\\|") for each in ("section", "report", "here"))
        assert "| {} | {} | {} | ".format(*cells) in text
    assert told[0]["figures"]["slope per arcmin"] == pytest.approx(0.109, abs=0.003)


def test_the_same_seed_gives_the_same_figures():
    one, again, other = (ROWS["IM-9"](Study(seed, quick=True)) for seed in (5, 5, 6))
    assert table(one) == table(again)
    assert table(one) != table(other)


def test_a_row_that_is_not_there_is_refused_by_name():
    with pytest.raises(BadInput, match="IM-12"):
        run_imaging(["IM-12"])
    with pytest.raises(BadInput, match="seed"):
        run_imaging(["IM-5"], seed=-1)
