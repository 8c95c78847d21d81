"""What a zone of some size costs, and which size recorded errors need."""

import numpy as np
import pytest

from service.features.advice.statements import zone_statements
from service.features.advice.zone_size import ZoneCost, zone_cost, zone_size
from service.mission_checks.zone_census import zone_censuses
from service.mission_checks.zone_estimate import geometric_k_g
from service.sky.catalog.run_catalog import build_run_catalog
from service.times import parse_utc

TIME = parse_utc("1996-01-10T12:00:00Z")


@pytest.mark.parametrize(("name", "k_g"), [("XTE", 0.4224), ("SWAS", 0.4224), ("SOHO", 0.0249)])
def test_k_g_is_that_of_the_paper_s_tables_13_and_14(missions, name, k_g):
    mission = missions[name]
    size_deg = zone_size(mission, [], []).size_deg
    assert round(geometric_k_g(mission, size_deg), 4) == k_g


@pytest.mark.slow
def test_soho_s_worst_band_is_about_that_of_the_paper(sky, missions):
    """Table 14 has 3,124 stars and 106,802 pairs, with the catalog of its day."""
    run_catalog = sky.run_catalog(missions["SOHO"], TIME)
    cost = zone_cost(missions["SOHO"], run_catalog.direction, 2.1)
    assert 3124 <= cost.stars <= 1.05 * 3124
    assert 106_802 <= cost.pairs <= 1.15 * 106_802
    # Equation 1 bounds it.
    assert cost.pairs < cost.k_g * cost.stars * (cost.stars - 1) / 2


def test_the_richest_zone_is_that_of_the_census(sky, missions):
    mission = missions["XTE"]
    run_catalog = build_run_catalog(sky.catalog, mission.catalog, 2000.0)
    (census,) = zone_censuses(mission, run_catalog)
    cost = zone_cost(mission, run_catalog.direction, 10.66)
    assert cost.stars == census.spread["stars"].most > census.stars.max()
    assert cost.pairs == pytest.approx(census.spread["pairs"].most, rel=0.005)


@pytest.mark.parametrize(
    ("angles", "verdict", "covering"),
    [
        ([1.0] * 49, "too_few", None),
        ([1.0] * 50, "larger_than_needed", 5.2),
        ([5.0] * 50, "fits", 10.0),
        ([5.0] * 50 + [7.0], "too_small", 12.4),
        # One that is far beyond the others is no reason for a larger zone.
        ([5.0] * 50 + [60.0], "fits", 10.0),
    ],
)
def test_the_size_follows_the_usual_errors(missions, angles, verdict, covering):
    found = zone_size(missions["XTE"], angles, [0.0] * len(angles))
    assert found.margin_deg == pytest.approx(6.66)
    assert (found.verdict, found.covering_deg) == (verdict, covering)
    assert found.errors.gross == sum(each > 50 for each in angles)
    assert found.errors.largest_deg == max(angles)


@pytest.mark.parametrize(("sigma_deg", "beyond"), [(0.08, 1), (0.09, 0)])
def test_an_error_counts_as_beyond_the_room_by_more_than_the_attitude_s_own(
    missions, sigma_deg, beyond
):
    """The room is 6.66 deg, and the last error 0.34 deg more."""
    sigmas_deg = [0.0] * 50 + [sigma_deg]
    found = zone_size(missions["XTE"], [5.0] * 50 + [7.0], sigmas_deg)
    assert found.errors.beyond == beyond
    assert found.verdict == ("too_small" if beyond else "fits")


def test_without_errors_only_the_present_size_is_weighed(missions):
    found = zone_size(missions["SOHO"], [], [])
    assert (found.errors, found.sizes_deg) == (None, [2.1])
    assert found.setting == "zone.half_width_deg"
    assert np.isclose(found.margin_deg, 0.1)


@pytest.mark.parametrize(
    ("angles", "action", "says"),
    [
        ([], "wait", "At least 50 batches"),
        ([5.0] * 50, "keep", "zone.radius_deg fits: 10.66° leaves room"),
        (
            [5.0] * 50 + [7.0],
            "widen",
            "in 1 of them it was more than there is room for. Set zone.radius",
        ),
        ([5.0] * 50 + [7.0], "widen", "then holds 1,240 pairs instead of 1,066."),
        ([1.0] * 50, "tighten", "zone.radius_deg = 5.2 covers that and a fifth more"),
        ([5.0] * 50 + [60.0], "keep", "Larger errors (1, up to 60.00°) are faults of their source"),
    ],
)
def test_the_size_is_told_in_words_with_what_it_costs(missions, angles, action, says):
    size = zone_size(missions["XTE"], angles, [0.0] * len(angles))
    costs = [ZoneCost(each, 10, round(100 * each), 0.4) for each in size.sizes_deg]
    told, _ = zone_statements(missions["XTE"], size, costs)
    assert told.action == action
    assert says in told.text


@pytest.mark.parametrize(
    ("limit_deg", "action"), [(3.9, "widen"), (8.0, "keep"), (8.3, "keep"), (12.0, "tighten")]
)
def test_hmax_is_the_width_of_the_field_of_view(missions, limit_deg, action):
    mission = missions["XTE"]
    tolerances = mission.tolerances.model_copy(update={"pair_separation_max_deg": limit_deg})
    mission = mission.model_copy(update={"tolerances": tolerances})
    *_, told = zone_statements(mission, zone_size(mission, [], []), [])
    assert (told.action, "pair_separation_max_deg" in told.text) == (action, True)
