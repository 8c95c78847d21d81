"""Telemetry with known faults is flown, and the advice finds just these."""

import itertools
import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from scipy import stats

from service.acquire import acquire
from service.features.advice.advice import WorkLimit
from service.features.advice.part import advice_record
from service.features.advice.records import Change
from service.features.advice.statements import (
    alignment_statement,
    group_statements,
    noise_statement,
)
from service.features.advice.text import advice_text, mission_lines
from service.features.advice.tolerances import rounded_up, tolerance_findings
from service.features.advice.trackers import alignment_findings, magnitude_findings, noise_findings
from service.identify.voting import starid
from service.missions.mission import Mission
from service.simulate.stretches import NO_TROUBLES, Trouble, Troubles
from service.storage.queries.results import BatchSample
from service.vectors import (
    ARCSEC_PER_RADIAN,
    angle_between_deg,
    matrix_from_quaternion,
    rotate_about,
    unit,
)
from tests.features.advice.passes import (
    advice_from,
    evidence_from,
    flown,
    mission_like,
    near,
    percentile_99,
    stars_of,
)

BATCHES = 150


def record_of(findings, batches_in_range=200):
    return advice_record("XTE", "r", BatchSample(batches_in_range, "a", "b", ()), findings, ())


def finding(mission, evidence, name):
    (found,) = [f for f in tolerance_findings(mission, evidence) if f.tolerance.name == name]
    return found


# ---- the trackers ------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "verdict"), [(1.0, "fits"), (2.0, "too_small")])
def test_the_noise_of_a_tracker_is_found(sky, missions, seed, factor, verdict):
    """Noise of the mission's sigma fits; twice as much is named, with the line to write."""
    mission = missions["XTE"]
    sigma_arcsec = factor * mission.trackers[0].sigma_arcsec
    troubles = Troubles(Trouble(), Trouble(), Trouble(), Trouble(1.0, sigma_arcsec))
    pass_ = flown(mission, sky, BATCHES, seed, troubles=troubles)
    (noise,) = noise_findings(mission, evidence_from(mission, sky, pass_.batches))
    assert near(noise.sigma_arcsec, sigma_arcsec)
    assert noise.sigma_arcsec.high - noise.sigma_arcsec.low < 0.4 * sigma_arcsec
    assert noise.verdict == verdict
    lines = [change.line for change in noise_statement(noise).changes]
    assert [line.split(" = ")[0] for line in lines] == ["sigma_arcsec"] * (verdict != "fits")


def worn(mission, begin, batches, factor):
    """A change of each batch in turn: noise that grows from a part of a pass on, to a multiple."""
    rng, number = np.random.default_rng(5), itertools.count()
    sigma_rad = mission.trackers[0].sigma_arcsec / ARCSEC_PER_RADIAN

    def change(body):
        part = max(0.0, (next(number) / batches - begin) / (1.0 - begin))
        more = sigma_rad * np.sqrt((1.0 + (factor - 1.0) * part) ** 2 - 1.0)
        for star in stars_of(body):
            star["vector"] = unit(np.array(star["vector"]) + rng.normal(0.0, more, 3)).tolist()

    return change


@pytest.mark.parametrize("begin", [0.8, 0.5])
def test_a_tracker_whose_noise_grows_does_not_fit_and_no_sigma_is_advised(
    sky, missions, seed, begin
):
    """Over the whole pass the median is that of the good batches, or of neither."""
    mission, batches = missions["XTE"], 200
    pass_ = flown(
        mission, sky, batches, seed, change=worn(mission, begin, batches, 5.0), angles_share=0.0
    )
    row = record_of(advice_from(mission, sky, pass_.batches[::-1]))
    (noise,) = row.noise
    assert noise.verdict == "too_small"
    assert noise.action == "correct"
    assert noise.sigma_arcsec.value > 3 * mission.trackers[0].sigma_arcsec
    assert noise.batches < batches / 2
    assert "Look at the tracker first" in noise.text
    assert row.changes == []
    text = advice_text(row)
    assert "The mission file needs no change" not in text
    assert "sigma_arcsec =" not in text


def test_noise_that_was_large_before_and_fits_now_is_left_alone(sky, missions, seed):
    mission, batches = missions["XTE"], 150
    rng, number = np.random.default_rng(5), itertools.count()
    sigma_rad = mission.trackers[0].sigma_arcsec / ARCSEC_PER_RADIAN

    def change(body):
        more = 3.0 * sigma_rad if next(number) < 90 else 0.0
        for star in stars_of(body):
            star["vector"] = unit(np.array(star["vector"]) + rng.normal(0.0, more, 3)).tolist()

    pass_ = flown(mission, sky, batches, seed, change=change, angles_share=0.0)
    (noise,) = noise_findings(mission, evidence_from(mission, sky, pass_.batches))
    assert noise.verdict == "fits"
    assert near(noise.sigma_arcsec, mission.trackers[0].sigma_arcsec)
    said = noise_statement(noise)
    assert (said.action, said.changes) == ("keep", ())
    assert "before" in said.text


@pytest.mark.parametrize("end", [90, 140])
def test_a_period_of_more_noise_is_told_though_the_tracker_has_recovered(sky, missions, seed, end):
    """What the range of an alarm asks for: how noisy the tracker was, and when."""
    mission, begin, batches = missions["XTE"], end - 40, 160
    rng, number = np.random.default_rng(5), itertools.count()
    sigma_arcsec = mission.trackers[0].sigma_arcsec
    more = np.sqrt(5.0**2 - 1.0) * sigma_arcsec / ARCSEC_PER_RADIAN

    def change(body):
        if begin <= next(number) < end:
            for star in stars_of(body):
                star["vector"] = unit(np.array(star["vector"]) + rng.normal(0.0, more, 3)).tolist()

    pass_ = flown(mission, sky, batches, seed, change=change, angles_share=0.0)
    (noise,) = noise_findings(mission, evidence_from(mission, sky, pass_.batches))
    assert noise.verdict == "fits"
    assert near(noise.sigma_arcsec, sigma_arcsec)
    assert near(noise.worst.sigma_arcsec, 5.0 * sigma_arcsec)
    # By chance the period may gain or lose a batch at each end, and with half the chance another.
    ends = (begin - 12, begin + 12, end - 13, end + 11)
    bounds = [pass_.batches[k].time.tai_ns for k in ends]
    assert bounds[0] <= noise.worst.first.tai_ns <= bounds[1]
    assert bounds[2] <= noise.worst.last.tai_ns <= bounds[3]
    ratio = noise.worst.sigma_arcsec.value / sigma_arcsec
    assert f"{ratio:.2f} times the mission's" in noise_statement(noise).text


def test_constant_noise_has_no_worst_period(sky, missions, seed):
    pass_ = flown(missions["XTE"], sky, BATCHES, seed, angles_share=0.0)
    (noise,) = noise_findings(missions["XTE"], evidence_from(missions["XTE"], sky, pass_.batches))
    assert noise.worst is None


def test_an_offset_and_a_scale_of_the_magnitudes_are_found(sky, missions, seed):
    """Magnitudes 0.4 fainter at 5 mag, a magnitude measured as 1.15."""

    def fainter(body):
        for star in stars_of(body):
            star["magnitude"] += 0.4 + 0.15 * (star["magnitude"] - 5.0)

    mission = missions["XTE"]
    pass_ = flown(mission, sky, BATCHES, seed, change=fainter)
    (found,) = magnitude_findings(mission, evidence_from(mission, sky, pass_.batches))
    assert near(found.offset_mag, 0.4 + 0.15 * (found.pivot_mag - 5.0))
    assert near(found.scale, 1.15)
    assert near(found.scatter_mag, 1.15 * 0.1)
    assert found.verdict == "off"


def test_the_line_for_the_magnitudes_undoes_their_offset(sky, missions, seed):
    """With the colour polynomial that is advised, the same stars have no offset left."""

    def fainter(body):
        for star in stars_of(body):
            star["magnitude"] += 0.35

    mission = missions["XTE"]
    pass_ = flown(mission, sky, BATCHES, seed, change=fainter)
    row = record_of(advice_from(mission, sky, pass_.batches[:60]))
    (line,) = [c.line for c in row.changes if c.table == "catalog"]
    key, value = line.partition("#")[0].split(" = ")
    polynomial = tuple(float(part) for part in value.strip(" []").split(","))
    better = mission.model_dump()
    better["catalog"][key.strip()] = polynomial
    mended = Mission.model_validate(better)
    (found,) = magnitude_findings(mended, evidence_from(mended, sky, pass_.batches))
    assert found.verdict == "fits"
    assert abs(found.offset_mag.value) < 0.03


def test_a_misaligned_tracker_is_found_and_the_lines_put_it_right(sky, seed):
    """The second tracker is turned by minutes of arc; with the advised axes nothing is left."""
    turn_arcsec = np.array([130.0, -80.0, 210.0])
    mission = mission_like(second_tracker={})
    true_axes = rotate_about(
        turn_arcsec / ARCSEC_PER_RADIAN, mission.trackers[1].body_from_tracker.T
    )
    names = ("x_axis_body", "y_axis_body", "z_axis_body")
    truly = mission_like(
        second_tracker={n: a.tolist() for n, a in zip(names, true_axes, strict=True)}
    )
    pass_ = flown(truly, sky, 60, seed)
    (found,) = alignment_findings(mission, evidence_from(mission, sky, pass_.batches))
    assert found.verdict == "off"
    for part, truth in zip(found.rotation_arcsec, turn_arcsec, strict=True):
        assert near(part, truth)
        assert part.high - part.low < 20.0
    advised = {
        change.line.split(" = ")[0]: [float(x) for x in change.line.split("[")[1][:-1].split(",")]
        for change in alignment_statement(found).changes
    }
    mended = mission_like(second_tracker=advised)
    (left,) = alignment_findings(mended, evidence_from(mended, sky, pass_.batches))
    assert left.verdict == "fits"
    assert max(abs(part.value) for part in left.rotation_arcsec) < 0.5


def test_trackers_that_are_aligned_are_left_alone(sky, seed):
    mission = mission_like(second_tracker={})
    pass_ = flown(mission, sky, 60, seed)
    (found,) = alignment_findings(mission, evidence_from(mission, sky, pass_.batches))
    assert found.verdict == "fits"
    assert all(near(part, 0.0) for part in found.rotation_arcsec)


# ---- the tolerances ----------------------------------------------------------------------------


def test_a_separation_tolerance_that_is_too_tight_is_found(sky, seed):
    """Of two Gaussian stars of 2.12 arcsec an axis, 99 % of separations lie within 7.73 arcsec."""
    mission = mission_like(tolerances={"separation_deg": 0.001})
    pass_ = flown(mission, sky, BATCHES, seed)
    found = finding(mission, evidence_from(mission, sky, pass_.batches), "separation_deg")
    sigma_deg = mission.trackers[0].sigma_arcsec * np.sqrt(2.0) / 3600.0
    assert found.verdict == "too_tight"
    assert near(found.needed, sigma_deg * stats.norm.ppf(0.995))
    assert near(found.beyond, 2 * stats.norm.sf(0.001 / sigma_deg))
    assert found.needed.high < found.recommended < 2 * found.needed.value


def test_the_tolerance_that_is_advised_is_no_longer_too_tight(sky, seed):
    mission = mission_like(tolerances={"separation_deg": 0.001})
    evidence = evidence_from(mission, sky, flown(mission, sky, BATCHES, seed).batches)
    advised = finding(mission, evidence, "separation_deg").recommended
    mended = mission_like(tolerances={"separation_deg": advised})
    assert finding(mended, evidence, "separation_deg").verdict == "fits"


@pytest.mark.parametrize("identifier", ["verified", "starid"])
def test_a_tolerance_is_changed_only_where_the_identifier_asks_for_it(sky, seed, identifier):
    """No line stands in the box that the sentence below takes back."""
    mission = mission_like(tolerances={"separation_deg": 0.001})
    mission = mission.model_copy(update={"identifier": identifier})
    pass_ = flown(mission, sky, 60, seed)
    row = record_of(advice_from(mission, sky, pass_.batches))
    found = next(each for each in row.tolerances if each.tolerance == "separation_deg")
    keys = [each.line.partition(" = ")[0] for each in row.changes]
    assert found.recommended > 0.001
    in_keys = "separation_deg" in keys
    if identifier == "starid":
        assert (found.verdict, found.action, in_keys) == ("too_tight", "widen", True)
    else:
        assert (found.verdict, found.action, in_keys) == ("not_used", "keep", False)
        assert "is not used by the identifier verified: no effect" in found.text
        assert "too tight" not in found.text


def test_a_tolerance_that_growing_noise_makes_too_tight_waits(sky, seed):
    mission = mission_like().model_copy(update={"identifier": "starid"})
    pass_ = flown(mission, sky, 150, seed, change=worn(mission, 0.6, 150, 8.0), angles_share=0.0)
    row = record_of(advice_from(mission, sky, pass_.batches))
    found = next(each for each in row.tolerances if each.tolerance == "separation_deg")
    assert (found.verdict, found.action) == ("too_tight", "wait")
    keys = {each.line.partition(" = ")[0] for each in row.changes}
    assert not keys & {"separation_deg", "sigma_arcsec"}


def test_lines_of_two_trackers_are_tables_with_their_names(sky, seed):
    change = Change(table="trackers", tracker="B", line="sigma_arcsec = 2 # was 1")
    row = record_of(advice_from(mission_like(), sky, flown(mission_like(), sky, 20, seed).batches))
    row = structs.replace(row, changes=[change, structs.replace(change, tracker="A")])
    assert tomllib.loads(mission_lines(row)) == {
        "trackers": [{"name": "A", "sigma_arcsec": 2}, {"name": "B", "sigma_arcsec": 2}]
    }


def test_two_trackers_with_the_same_offset_give_one_line(sky, seed):
    """A key that stands in a table twice is no TOML."""

    def fainter(body):
        for star in stars_of(body):
            star["magnitude"] += 0.35

    mission = mission_like(second_tracker={})
    row = record_of(
        advice_from(mission, sky, flown(mission, sky, 40, seed, change=fainter).batches)
    )
    lines = [each.line for each in row.changes if each.table == "catalog"]
    assert [line.partition(" = ")[0] for line in lines] == ["color_polynomial_mag"]


def test_a_magnitude_tolerance_that_is_too_tight_is_found(sky, seed):
    mission = mission_like(tolerances={"magnitude_mag": 0.12})
    evidence = evidence_from(mission, sky, flown(mission, sky, BATCHES, seed).batches)
    found = finding(mission, evidence, "magnitude_mag")
    assert found.verdict == "too_tight"
    assert near(found.needed, 0.1 * stats.norm.ppf(0.995))


@pytest.mark.parametrize(("now", "verdict"), [(0.1, "too_tight"), (0.6, "fits"), (3.0, "too_wide")])
def test_the_difference_that_orders_by_brightness_is_judged_by_that_of_pairs(
    sky, seed, now, verdict
):
    """A difference of two magnitudes scatters by the root of two times the tracker's sigma."""
    mission = mission_like(tolerances={"magnitude_order_mag": now})
    evidence = evidence_from(mission, sky, flown(mission, sky, BATCHES, seed).batches)
    found = finding(mission, evidence, "magnitude_order_mag")
    assert found.verdict == verdict
    assert near(found.needed, math.sqrt(2.0) * 0.1 * stats.norm.ppf(0.995))


def test_a_cross_product_tolerance_near_the_attitude_errors_is_too_tight(sky, seed):
    """The a priori attitude is degrees off: the true angles follow from the truth of the pass."""
    mission = mission_like(tolerances={"cross_product_deg": 2.0})
    pass_ = flown(mission, sky, BATCHES, seed, angles_share=0.0)
    found = finding(mission, evidence_from(mission, sky, pass_.batches), "cross_product_deg")
    true_angles = []
    for body, truth in zip(pass_.sent, pass_.truth, strict=True):
        tracker = mission.trackers[0]
        seen = np.array([s["vector"] for s in stars_of(body)]) @ tracker.body_from_tracker.T
        i, j = np.triu_indices(len(seen), 1)
        normal = np.cross(seen[i], seen[j])
        presumed = matrix_from_quaternion(body["a_priori"]["quaternion"])
        true = matrix_from_quaternion(truth["quaternion"])
        true_angles += angle_between_deg(normal @ presumed, normal @ true).tolist()
    assert found.verdict == "too_tight"
    assert near(found.needed, percentile_99(true_angles))
    assert near(found.beyond, np.mean(np.array(true_angles) > 2.0))


def test_a_pole_tolerance_far_above_what_is_seen_is_wide(sky, missions, seed):
    """SOHO's pole is known to 0.1 degrees, and BANTOL1 is 0.13."""
    mission = missions["SOHO"]
    evidence = evidence_from(mission, sky, flown(mission, sky, BATCHES, seed).batches)
    assert finding(mission, evidence, "pole_difference_deg").verdict == "too_wide"
    # A degree off about the pole turns angles to it by no more than a tilt of that size does.
    assert finding(mission, evidence, "pole_angle_deg").needed.value < 0.12


def test_a_tolerance_whose_test_is_off_is_not_judged(sky, seed):
    mission = mission_like(tests={"cross_product": False}, tolerances={"cross_product_deg": 0.1})
    evidence = evidence_from(mission, sky, flown(mission, sky, 30, seed).batches)
    assert finding(mission, evidence, "cross_product_deg").verdict == "not_used"


def test_of_a_few_batches_nothing_is_said(sky, missions, seed):
    mission = missions["XTE"].model_copy(update={"identifier": "starid"})
    row = record_of(advice_from(mission, sky, flown(mission, sky, 6, seed).batches))
    assert row.changes == []
    findings = row.tolerances + row.noise + row.magnitudes
    assert {each.action for each in findings} == {"wait"}
    assert all("too little data" in each.text for each in findings)


def test_of_no_batches_nothing_is_said(sky, missions):
    row = record_of(advice_from(missions["SOHO"], sky, []))
    assert row.changes == []
    assert row.batches_sampled == 0


def test_a_pass_as_the_mission_expects_it_needs_no_tighter_or_wider_separation(sky, missions, seed):
    mission = missions["XTE"]
    evidence = evidence_from(mission, sky, flown(mission, sky, BATCHES, seed).batches)
    assert finding(mission, evidence, "separation_deg").verdict == "fits"
    assert finding(mission, evidence, "magnitude_mag").verdict == "fits"
    assert [f.verdict for f in noise_findings(mission, evidence)] == ["fits"]
    assert [f.verdict for f in magnitude_findings(mission, evidence)] == ["fits"]


@pytest.mark.parametrize(
    ("value", "rounded"), [(0.001234, 0.0013), (0.012, 0.012), (5.21, 5.3), (0.0, 0.0), (99.1, 100)]
)
def test_a_recommended_value_is_one_a_person_would_write(value, rounded):
    assert rounded_up(value) == rounded


# ---- other settings ----------------------------------------------------------------------------


def test_what_was_tried_is_what_an_acquisition_gives(sky, seed):
    """Each row's counts are those of the batches run one by one with these settings."""
    mission = mission_like(tolerances={"separation_deg": 0.002})
    pass_ = flown(mission, sky, 25, seed, troubles=Troubles())
    advice = advice_from(mission, sky, pass_.batches, own={"separation_deg": 0.015})
    rows = {(t.variant.name, t.variant.identifier): t for t in advice.trials}
    for (_, identifier), row in rows.items():
        changed = dict(row.variant.tolerances)
        again = mission_like(
            tolerances={"separation_deg": 0.002} | changed,
        ).model_copy(update={"identifier": identifier})
        counts = [acquire(batch, again.within_zones, sky).counts for batch in pass_.batches]
        for name in ("observed", "unique", "ambiguous", "unmatched"):
            assert getattr(row, name) == sum(each[name] for each in counts)
    present = rows["present settings", "starid"]
    asked = rows["separation_deg = 0.015, asked for", "starid"]
    assert present.change is None
    lost = 100 * (present.unique - asked.unique) / present.observed
    assert asked.change.value == pytest.approx(lost)
    assert rows["present settings", "verified"].other_star == 0


def test_a_batch_that_no_longer_fits_is_counted_and_passed_by(sky, missions, seed):
    mission = missions["XTE"]
    batches = flown(mission, sky, 5, seed).batches
    foreign = flown(missions["SOHO"], sky, 1, seed, prior="direction").batches
    advice = advice_from(mission, sky, [*batches, *foreign])
    assert (advice.sampled, advice.refused) == (5, 1)
    assert "sun_pointed" in advice.refusal


def test_a_tolerance_too_wide_to_be_tried_takes_no_batch_from_other_trials(
    sky, missions, seed, monkeypatch
):
    monkeypatch.setattr(starid, "MAX_COMPARISONS", 2_000)
    mission = missions["XTE"].model_copy(update={"identifier": "starid"})
    batches = flown(mission, sky, 5, seed).batches
    with_own = advice_from(mission, sky, batches, own={"separation_deg": 5.0})
    *others, asked = with_own.trials
    assert (with_own.sampled, with_own.refused, with_own.refusal) == (5, 0, None)
    assert "asked for" in asked.variant.name
    assert asked.batches == 0
    assert {each.batches for each in others} == {5}


def test_a_mirrored_sensor_is_suggested_only_beyond_chance(sky, missions, seed):
    mission = missions["XTE"]
    advice = advice_from(mission, sky, flown(mission, sky, 5, seed).batches)
    assert group_statements(advice) == []
    for mirrored, sampled, is_told in (
        (1, 1, False),
        (1, 300, False),
        (6, 300, False),
        (3, 3, True),
        (250, 300, True),
    ):
        found = replace(advice, mirrored=mirrored, sampled=sampled)
        assert bool(group_statements(found)) is is_told


def test_where_time_runs_out_fewer_batches_are_looked_at_and_the_answer_says_so(
    sky, missions, seed
):
    steps = []
    pace = WorkLimit(lambda share: len(steps) < 20 * share, lambda: steps.append(1))
    mission = missions["XTE"].model_copy(update={"identifier": "starid"})
    advice = advice_from(mission, sky, flown(mission, sky, 40, seed).batches, pace=pace)
    assert advice.sampled == 8
    assert {t.batches for t in advice.trials if t.variant.identifier == "starid"} == {8}


def test_the_text_can_be_acted_upon(sky, seed):
    """Every change stands under its table, as TOML that a mission file takes."""
    mission = mission_like(tolerances={"separation_deg": 0.001})
    mission = mission.model_copy(update={"identifier": "starid"})
    pass_ = flown(mission, sky, 60, seed, troubles=NO_TROUBLES)
    advice = advice_from(mission, sky, pass_.batches)
    text = advice_text(record_of(advice, 99))
    assert "60 of 99 batches were examined." in text
    assert "separation_deg is too tight" in text
    changes = tomllib.loads(text.partition("To change in the mission file of XTE:")[2])
    assert 0.002 < changes["tolerances"]["separation_deg"] < 0.005
    assert max(len(each) for each in text.splitlines()) <= 100
