"""Ten lines for trackers of data sheets: telemetry is identified as the paper's rules predict.

The tolerances follow from the lines by the factors of the paper's Table 1, and the prediction is
its simulator.  Fields and errors are those of:

- the star tracker of ROSAT: SPIE, doi 10.1117/12.968097 (5.9 x 4.4 deg, 2 arcsec, 6.5 mag);
- TOAST, of TPD: ESA SP-255 (1986), p. 295 (8.1 x 5.4 deg, 1.5 arcsec, 6.5 mag);
- the wide sensor of a test facility: doi 10.1155/2013/505720, table 6 (22.48 x 17.02 deg, 7 mag;
  the error is taken as a tenth of its pixel of 61 arcsec).
"""

import json

import numpy as np
import pytest

from service.acquire import acquire
from service.intervals import share_of
from service.missions.mission import parse_mission
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from studies.mission_rates.simulation import Plan, one_tracker, settings_of, simulate
from tests.scale import draws

SHEETS = {
    "ROSAT": ("[5.9, 4.4]", 2.0, 6.5),
    "TOAST": ("[8.1, 5.4]", 1.5, 6.5),
    "WIDE": ("[22.48, 17.02]", 6.1, 7.0),
}


def mission_of(name):
    field, sigma, limit = SHEETS[name]
    text = f"""name = "{name}"
identifier = "starid"
a_priori_error_deg = 0.5
[[trackers]]
x_axis_body = [1.0, 0.0, 0.0]
z_axis_body = [0.0, 0.0, 1.0]
field_of_view_deg = {field}
sigma_arcsec = {sigma}
limit_mag = {limit}
"""
    assert len(text.splitlines()) <= 10
    return parse_mission(text, f"{name}.toml")


def shares_of_telemetry(mission, sky, batches, seed):
    """The shares of stars that are unique and right, and unique and wrong, all over the sky.

    Each batch is of a pass of its own: those of one pass see one place of the sky, whose density
    of stars they share.
    """
    right, wrong, batch = [], [], []
    for k in range(batches):
        wanted = Pass(1, seed + k, stars=5, troubles=NO_TROUBLES)
        (drawn,) = draw_pass(mission, sky, wanted)
        found = acquire(submission_from_json(json.dumps(drawn.batch)).batch, mission, sky)
        for truth, tracker in zip(drawn.truth["observations"], found.trackers, strict=True):
            named = tracker.identification
            for true, star, unique in zip(truth["stars"], named.star, named.unique, strict=True):
                is_true = found.run_catalog.star_id[star] == true
                right.append(bool(unique) and is_true)
                wrong.append(bool(unique) and not is_true)
                batch.append(k)
    return [share_of(np.array(each), np.array(batch)) for each in (right, wrong)]


@pytest.mark.parametrize("name", SHEETS)
def test_telemetry_has_the_shares_that_the_rules_of_the_paper_predict(name, sky, seed):
    """Within both intervals, each made twice as wide, for no seed is to fail by chance."""
    mission = one_tracker(mission_of(name), None)
    settings = tuple(settings_of(mission, []))
    plan = Plan(settings, "starid", {}, None, 180.0, draws(24, 120), 10, 5, seed)
    (rates,) = simulate(plan, processes=1, quiet=True)
    telemetry = shares_of_telemetry(mission, sky, draws(150, 1000), seed)
    for predicted, found in zip((rates.unique_right, rates.wrong), telemetry, strict=True):
        reach = (predicted.high - predicted.low) + (found.high - found.low)
        assert found.value == pytest.approx(predicted.value, abs=reach)
