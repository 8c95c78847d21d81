"""The paper's simulator: what it draws, what it counts, and that the rates are the paper's."""

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from scipy.stats import truncnorm

from service.acquire import acquire
from service.errors import BadInput
from service.vectors import angle_between_deg, matrix_from_quaternion
from studies.paper_1994.command import run_paper
from studies.paper_1994.experiments import run_experiments
from studies.paper_1994.printed import PrintedCounts, the_paper
from studies.paper_1994.tables import geometric_share, measure, proportion
from studies.paper_1994.tally import (
    CHI_SQUARE_95,
    Spread,
    Tally,
    distance_squared,
    is_inside,
    spread,
)
from studies.paper_1994.views import (
    EPOCH,
    View,
    batch_of,
    draw_zone,
    paper_mission,
    rotation,
)
from tests.chance import at_most
from tests.scale import draws, is_full, some_in_a_sitting


def run_named(table, name):
    return next(run for run in the_paper().runs if (run.table, run.run) == (table, name))


class TestPrinted:
    def test_there_are_94_runs_of_tables_2_to_10(self):
        paper = the_paper()
        assert len(paper.runs) == 94
        assert {run.number for run in paper.runs} == set(range(2, 11))
        assert sum(not run.geometry for run in paper.runs) == 2

    def test_counts_add_up(self):
        for run in the_paper().runs:
            counts = run.printed
            total = counts.ambiguous + counts.correct + counts.misidentified
            assert total == counts.stars, run

    def test_the_reference_stays_near_the_print(self):
        """By its own means and deviations, correlation left aside, most runs lie inside."""
        inside = sum(
            distance_squared(run.printed, reference_spread(run)) <= CHI_SQUARE_95
            for run in the_paper().runs
        )
        assert 85 <= inside <= 94


def reference_spread(run):
    reference = run.reference
    stars = reference.stars / 40
    mean = np.array([reference.unidentified_pct, reference.misidentified_pct]) * stars / 100
    sd = np.array([reference.sd_unidentified_pct, reference.sd_misidentified_pct]) * stars / 100
    return Spread(40.0, stars, mean, np.diag(sd**2))


class TestRegion:
    @pytest.mark.parametrize(
        ("table", "name", "distance"),
        [("2", 'psi60"', 0.41), ("2", "psi10", 0.46), ("6", "so3", 0.41), ("7", "so0", 1.58)],
    )
    def test_known_distances(self, table, name, distance):
        run = run_named(table, name)
        assert distance_squared(run.printed, reference_spread(run)) == pytest.approx(
            distance, abs=0.03
        )

    def test_an_experiment_spreads_as_its_zones_do(self):
        """80 zones of 50 stars, 1 and 3 of them in turn not identified: worked by hand."""
        counts = np.zeros((80, 4), np.int64)
        counts[0::2, 0], counts[1::2, 0] = 1, 3
        counts[:, 2] = 50 - counts[:, 0]
        ours = spread(Tally(run_named("9F", "nominal"), "starid", counts))
        assert ours.experiments == 2
        assert ours.stars == 2000
        assert ours.mean.tolist() == [80.0, 0.0]
        assert ours.covariance[0, 0] == pytest.approx(40 * 80 / 79)
        # d = -80, C = 1.5 * 40 * 80 / 79 + 0.5
        printed = PrintedCounts(stars=2000, ambiguous=0, correct=2000, misidentified=0)
        assert distance_squared(printed, ours) == pytest.approx(80**2 / (4800 / 79 + 0.5))

    def test_what_differs_from_date_to_date_of_the_sun_is_no_spread(self):
        counts = np.zeros((84, 4), np.int64)
        counts[:, 1] = np.arange(84) % 7
        counts[:, 2] = 50 - counts[:, 1]
        ours = spread(Tally(run_named("8", "nominal"), "starid", counts))
        assert np.all(ours.covariance == 0.0)

    def test_a_run_far_off_lies_outside(self):
        counts = np.zeros((40, 4), np.int64)
        counts[:, 2] = 50
        assert is_inside(Tally(run_named("9F", "nominal"), "starid", counts))
        assert not is_inside(Tally(run_named("9F", "psi90"), "starid", counts))


class TestViews:
    @pytest.mark.parametrize("world", the_paper().worlds)
    def test_a_view_lies_where_the_paper_puts_it(self, sky, missions, rng, world):
        place = the_paper().worlds[world]
        mission = missions[place.mission]
        catalog = sky.run_catalog(mission, EPOCH)
        tracker = mission.trackers[0]
        for view in draw_zone(place, 3, mission, catalog, rng):
            body_x, body_z = view.attitude[0], view.attitude[2]
            assert angle_between_deg(body_x, view.axis) <= place.off_axis_deg
            boresight = body_x if place.mission == "XTE" else body_z
            off = angle_between_deg(view.direction, boresight)
            assert np.all(off <= tracker.field_of_view_radius_deg + 1e-9)
            assert len(view.star) <= 5
            assert len(set(view.star.tolist())) == len(view.star)

    def test_the_a_priori_attitude_carries_the_sensor_vectors_to_the_papers_inertial_ones(
        self, sky, missions, rng
    ):
        run = run_named("3", "5,5,270")
        mission = missions["SOHO"]
        catalog = sky.run_catalog(mission, EPOCH)
        for view in draw_zone(the_paper().worlds["band"], 0, mission, catalog, rng):
            batch = batch_of(view, run, mission, "starid")
            prior = matrix_from_quaternion(batch.a_priori.quaternion)
            alignment = mission.trackers[0].body_from_tracker
            inertial = batch.observations[0].vector @ alignment.T @ prior
            assert np.allclose(inertial, view.seen(run)[0], atol=1e-12)
            assert np.allclose(prior.T @ mission.axis_body, view.axis, atol=1e-12)

    def test_the_attitude_error_turns_about_z_then_y_then_x(self):
        run = run_named("2", "phi100")
        turned = rotation(run) @ [1.0, 0.0, 0.0]
        phi = math.radians(100.0)
        assert np.allclose(turned, [math.cos(phi), -math.sin(phi), 0.0], atol=1e-3)
        about_x = rotation(run_named("2", "psi100")) @ [1.0, 0.0, 0.0]
        assert np.allclose(about_x, [1.0, 0.0, 0.0], atol=1e-3)

    def test_position_errors_have_one_gaussian_radius(self, sky, missions, rng):
        """The mean of a half-normal is 0.798 sigma, that of two-axis noise 1.253."""
        run, still = run_named("6", "so21"), run_named("6", "so0")
        mission, world = missions["XTE"], the_paper().worlds["cap"]
        catalog = sky.run_catalog(mission, EPOCH)
        moved = np.concatenate(
            [
                3600.0 * angle_between_deg(view.seen(run)[0], view.seen(still)[0])
                for zone in range(60)
                for view in draw_zone(world, zone, mission, catalog, rng)
            ]
        )
        # 2,900 stars or so: the mean's deviation is 0.011 sigma.
        assert moved.mean() / 21.0 == pytest.approx(math.sqrt(2.0 / math.pi), abs=0.08)

    def test_magnitude_errors_end_at_their_bound(self, sky, missions, rng):
        mission, world = missions["XTE"], the_paper().worlds["cap_forest"]
        catalog = sky.run_catalog(mission, EPOCH)
        for run in (run_named("4", "sm0.1"), run_named("4", "sm1.0")):
            views = draw_zone(world, 0, mission, catalog, rng)
            errors = np.concatenate([v.seen(run)[1] - v.magnitude_mag for v in views])
            assert np.all(np.abs(errors) <= run.bound_mag)
            assert 0.5 * run.sigma_mag < errors.std() < 2.0 * run.sigma_mag

    @pytest.mark.parametrize("bound_sigmas", [0.5, 2.0, 6.0])
    def test_magnitude_errors_are_a_gaussian_cut_off_at_the_bound(self, bound_sigmas):
        """The whole range of the draw, its ends included, against SciPy's truncated Gaussian."""
        share = np.linspace(0.0, 1.0, 41)
        count = len(share)
        view = View(
            axis=np.array([1.0, 0.0, 0.0]),
            attitude=np.eye(3),
            star=np.arange(count),
            direction=np.tile([1.0, 0.0, 0.0], (count, 1)),
            magnitude_mag=np.linspace(1.0, 6.0, count),
            radius=np.zeros(count),
            bearing_rad=np.zeros(count),
            share=share,
        )
        run = run_named("4", "sm1.0")
        run = replace(run, bound_mag=bound_sigmas * run.sigma_mag)
        expected = truncnorm.ppf(share, -bound_sigmas, bound_sigmas, scale=run.sigma_mag)
        errors = view.seen(run)[1] - view.magnitude_mag
        assert errors == pytest.approx(expected, abs=1e-7)


RUNS = [
    ("2", 'psi60"'),
    ("2", "psi100"),
    ("2", "phi110"),
    ("2", "run6 geom off"),
    ("3", "5,5,5"),
    ("3", "run16 geom off"),
    ("4", "sm1.0"),
    ("5", "sm0.5"),
    ("6", "so21"),
    ("7", "so21"),
    ("8", "att 3,3,3"),
    ("10F", "mag .3"),
]


def test_rates_are_those_of_the_reference(seed):
    """One experiment a run, within six standard deviations, and a little for rare outcomes."""
    runs = [run_named(*name) for name in (RUNS if is_full() else RUNS[::3])]
    for tally in run_experiments(runs, 1, [seed], processes=1):
        ours, reference = spread(tally), tally.run.reference
        assert ours.stars == pytest.approx(tally.run.printed.stars, rel=0.1)
        rates = 100.0 * ours.mean / ours.stars
        assert rates[0] == pytest.approx(
            reference.unidentified_pct, abs=6.0 * reference.sd_unidentified_pct + 1.0
        ), tally.run
        assert rates[1] == pytest.approx(
            reference.misidentified_pct, abs=6.0 * reference.sd_misidentified_pct + 1.0
        ), tally.run


def test_at_psi_100_a_cap_of_120_deg_gives_what_geometry_off_gives(sky, rng):
    """Section 2's ambiguous geometry: with a vote for each pairing hardly a star is lost.

    With 90 deg every pair that the magnitudes do not order is taken the wrong way round.
    """
    paper, run = the_paper(), run_named("2", "psi100")
    mission = paper_mission("XTE")
    catalog = sky.run_catalog(mission, EPOCH)
    off = {"tests": {"cross_product": False}}
    wide = {"tolerances": {"cross_product_deg": 120.0}}
    counts = np.zeros((3, 3), int)
    zones = draws(16, 40)
    for number in range(zones):
        for view in draw_zone(paper.worlds[run.world], number, mission, catalog, rng):
            batch = batch_of(view, run, mission, "starid")
            for k, chosen in enumerate((off, wide, {})):
                options = structs.replace(batch.options, **chosen)
                found = acquire(structs.replace(batch, options=options), mission, sky)
                (tracker,) = found.trackers
                star = tracker.identification.star
                counts[k] += (star < 0).sum(), (star == view.star).sum(), (star >= 0).sum()
    total = counts[0, 0] + counts[0, 2]
    assert total > 38 * zones
    unidentified, right, named = counts.T
    # The reference, Table 2 run 6: 0.75 % not identified, 0.06 % misidentified.
    assert (unidentified[:2] <= at_most(total, 0.01)).all()
    assert (named[:2] - right[:2] <= at_most(total, 0.001)).all()
    assert unidentified[1] <= unidentified[0] + at_most(total, 0.001)
    assert right[2] < 0.1 * total


@pytest.mark.slow
def test_the_same_seed_gives_the_same_counts_however_the_work_is_shared(seed):
    runs = [run_named("2", "psi100"), run_named("4", "sm1.0")]
    alone, shared = (run_experiments(runs, 600, [seed], processes=n) for n in (1, 2))
    other = run_experiments(runs, 600, [seed + 1], processes=1)
    for one, two, three in zip(alone, shared, other, strict=True):
        assert np.array_equal(one.counts, two.counts)
        assert not np.array_equal(one.counts, three.counts)
        assert one.stars >= 600


def test_the_command_prints_a_table_and_writes_its_rows(tmp_path, seed):
    out, path = io.StringIO(), tmp_path / "rows.json"
    run_paper(8, 1, [seed], path, ["starid"], processes=1, plots=tmp_path, out=out)
    rows = json.loads(path.read_text(encoding="utf-8"))
    asked = [run for run in the_paper().runs if run.number == 8]
    assert [(row["table"], row["run"]) for row in rows] == [(run.table, run.run) for run in asked]
    for row in rows:
        assert set(row) == {
            "table", "run", "identifier", "stars",
            "ambiguous", "unmatched", "correct", "misidentified",
        }  # fmt: skip
        assert row["identifier"] == "starid"
        outcomes = ("ambiguous", "unmatched", "correct", "misidentified")
        assert sum(row[name] for name in outcomes) == row["stars"]
    text = out.getvalue()
    assert "### Table 8." in text
    assert "of 4" in text
    assert (tmp_path / "paper-places.svg").stat().st_size > 0


@pytest.mark.parametrize("table", some_in_a_sitting(range(2, 11)))
@pytest.mark.slow("10")
def test_the_rates_of_the_text_are_those_of_the_rows(table, tmp_path, seed):
    out, path = io.StringIO(), tmp_path / "rows.json"
    run_paper(table, 1, [seed], path, processes=1, out=out)
    starid, verified = out.getvalue().split("by the identifier `verified`")
    rows = json.loads(path.read_text(encoding="utf-8"))
    assert {row["identifier"] for row in rows} == {"starid", "verified"}
    for row in rows:
        stars, wrong = row["stars"], row["misidentified"]
        missed = row["ambiguous"] + row["unmatched"]
        if row["identifier"] == "starid":
            shown = [
                f" {stars} |",
                f" {100 * missed / stars:.2f} ±",
                f" {100 * wrong / stars:.2f} ±",
            ]
        else:
            counts = (row["ambiguous"], row["unmatched"], wrong)
            shown = [f" {stars} |", *(f" {n} ({100 * n / stars:.2f} %)" for n in counts)]
        text = starid if row["identifier"] == "starid" else verified
        lines = [line for line in text.splitlines() if f" {row['run']} " in line]
        assert any(all(each in line for each in shown) for line in lines), (row, lines)


@pytest.mark.parametrize("table", [11, 12, 13, 14])
def test_the_rows_of_times_and_sizes_are_those_of_the_text(table, tmp_path, seed):
    out, path = io.StringIO(), tmp_path / "rows.json"
    rows = run_paper(table, seeds=[seed], json_path=path, identifiers=["starid"], out=out)
    text = out.getvalue()
    assert json.loads(path.read_text(encoding="utf-8")) == rows
    assert len(rows) >= 3
    for row in rows:
        assert (row["table"], row["case"] in text) == (table, True)
        if table < 13:
            assert all(f"{each:.3f}" in text for each in (*row["first_ms"], row["all_ms"]))
        else:
            assert f" {row['pairs']} " in text
            assert f" {row['k_g']:.4f} " in text
    assert ("The mission allows" in text) == (table < 13)


@pytest.mark.parametrize(
    "asked",
    [
        {"table": 1},
        {"table": 15},
        {"stars": 0},
        {"seeds": [-1]},
        {"identifiers": ["ptp"]},
        {"table": 11, "seeds": [1, 2]},
    ],
)
def test_what_the_paper_has_not_is_refused(asked):
    with pytest.raises(BadInput):
        run_paper(**asked)


def test_times_and_k_g_are_of_the_papers_zones(seed):
    desert = next(case for case in the_paper().times if case.world == "cap_desert")
    zones = measure(desert, seed)
    assert len(zones) == 10
    for zone in zones:
        assert zone.stars == pytest.approx(desert.stars[0], rel=0.08)
        assert zone.pairs == pytest.approx(desert.pairs[0], rel=0.15)
        assert 0.0 < zone.generate_s < 1.0
        assert len(zone.later_s) == 9


def test_k_g_is_the_papers_by_both_of_its_equations():
    """Equation 1 of NCAP and NTOT, equation 2 of the areas: every row of Tables 13 and 14."""
    printed = the_paper().proportions
    assert len(printed) == 8
    for row in printed:
        mission = paper_mission("XTE" if row.table == "13" else "SOHO")
        assert geometric_share(mission) == pytest.approx(row.geometric, abs=5e-5)
        assert proportion(row.stars, row.pairs) == pytest.approx(row.apparent, abs=1e-3)
