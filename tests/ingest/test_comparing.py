"""Two sets of options over the same batches: every star counted, nothing kept."""

import pytest

from service.errors import NotFound
from service.observations.schema import OptionsIn

NONE = OptionsIn()
TIGHT = OptionsIn.model_validate({"tolerances": {"separation_deg": 1e-5}, "identifier": "starid"})
VOTES = OptionsIn.model_validate({"identifier": "starid"})


@pytest.fixture
def filled(app, make):
    kinds = ["good", "spurious", "good", "suspect", "one_star", "good"]
    app.submissions.submit_many(
        [make(f"b{k}", kind=kind, after_s=30.0 * k) for k, kind in enumerate(kinds)]
    )
    return app


def transitions(found):
    return {(each.from_, each.to): each.stars for each in found.transitions}


def test_equal_options_change_nothing(filled):
    found = filled.comparisons.of_options("XTE", NONE, NONE)
    assert found.compared == found.sampled == found.batches_in_stretch == 6
    assert found.changed == []
    assert found.renamed == 0
    assert all(each.from_ == each.to for each in found.transitions)
    assert found.attitudes.angle_arcsec_max == 0.0
    assert found.attitudes.neither == 1
    recorded = filled.spacecraft.rates("XTE")[0]
    for name in ("observed", "unique", "ambiguous", "unmatched", "solved", "suspect"):
        assert getattr(found.a, name) == getattr(recorded, name)


@pytest.mark.both_databases
def test_what_changes_is_what_a_what_if_of_each_batch_says(filled):
    found = filled.comparisons.of_options("XTE", VOTES, TIGHT)
    counted = {"unique": 0, "ambiguous": 0, "unmatched": 0}
    for each in filled.results.page().items:
        told = filled.results.what_if(each.id, TIGHT).body.decode()
        for name in counted:
            counted[name] += told.count(f'"outcome":"{name}"')
    assert {name: getattr(found.b, name) for name in counted} == counted
    assert sum(transitions(found).values()) == found.a.observed == found.b.observed
    moved = sum(stars for (one, other), stars in transitions(found).items() if one != other)
    shown = [star for each in found.changed for star in each.stars]
    assert moved > 0
    assert len(shown) == moved + found.renamed
    assert found.changed_batches == len(found.changed)
    for each in found.changed:
        answer = filled.results.get(each.id).answer
        assert (answer.batch, answer.time) == (each.batch, each.time)


def test_the_trends_count_every_star_in_the_hour_of_its_batch(filled, make):
    filled.submissions.submit_many(
        [
            make(f"late{k}", kind="spurious", after_s=hour * 3600.0)
            for k, hour in enumerate((2, 2, 5))
        ]
    )
    found = filled.comparisons.of_options("XTE", VOTES, TIGHT)
    assert found.cell_s == 3600
    first = make(after_s=0.0).batch.time.text[:14] + "00:00.000Z"
    hours = [int(each.start[11:13]) - int(first[11:13]) for each in found.trend]
    assert (found.trend[0].start, hours) == (first, [0, 2, 5])
    for side in ("a", "b"):
        cells, whole = [getattr(each, side) for each in found.trend], getattr(found, side)
        for name in ("observed", "unique", "ambiguous", "unmatched"):
            assert sum(getattr(each, name) for each in cells) == getattr(whole, name)
    a_batch = found.trend[2].a.observed
    assert (found.trend[1].a.observed, found.trend[1].b.observed) == (2 * a_batch, 2 * a_batch)


def test_the_answers_do_not_depend_on_how_many_are_solved_at_once(filled, monkeypatch):
    monkeypatch.setattr("service.ingest.compare_options.PORTION_S", 0.0)
    alone = filled.comparisons.of_options("XTE", VOTES, TIGHT)
    monkeypatch.setattr("service.ingest.compare_options.PORTION_S", 60.0)
    together = filled.comparisons.of_options("XTE", VOTES, TIGHT)
    assert (together.changed, together.trend) == (alone.changed, alone.trend)
    assert (together.transitions, together.attitudes) == (alone.transitions, alone.attitudes)


def test_nothing_is_kept(filled):
    before = filled.results.page().items
    filled.comparisons.of_options("XTE", NONE, TIGHT)
    assert filled.results.page().items == before
    assert all(filled.results.get(each.id).what_ifs == [] for each in before)


def test_a_stretch_a_sample_and_a_bound_on_the_work(filled, make):
    start, end = (make(after_s=seconds).batch.time for seconds in (30, 120))
    assert filled.comparisons.of_options("XTE", NONE, NONE, start=start, end=end).compared == 3
    few = filled.comparisons.of_options("XTE", NONE, NONE, sample=2)
    assert (few.batches_in_stretch, few.sampled, few.compared) == (6, 2, 2)
    cut = filled.comparisons.of_options("XTE", NONE, NONE, limit_s=-1.0)
    assert (cut.cut_short, cut.compared, cut.sampled) == (True, 0, 6)
    empty = filled.comparisons.of_options("XTE", NONE, NONE, run="nothing")
    assert (empty.compared, empty.start, empty.a.residual_ratio_mean) == (0, None, None)
    assert empty.trend == []
    with pytest.raises(NotFound):
        filled.comparisons.of_options("NOPE", NONE, NONE)
