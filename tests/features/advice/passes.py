"""Passes whose noise, magnitudes, alignment and a priori errors are known."""

import json
import tomllib
from dataclasses import dataclass

import numpy as np
from msgspec import structs

from service.acquire import acquire
from service.features.advice.advice import advise
from service.features.advice.evidence import evidence_of, merged
from service.missions.defaults import completed
from service.missions.mission import SHIPPED_FOLDER, Mission
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass


def mission_like(name="XTE", *, second_tracker=None, **changed):
    """A shipped mission with other tables: mission_like(tolerances={"separation_deg": 0.001}).

    `second_tracker` adds one that looks along body Y, with these keys in place of its own.
    """
    text = (SHIPPED_FOLDER / f"{name.lower()}.toml").read_text(encoding="utf-8")
    settings = completed(tomllib.loads(text)).table
    for table, values in changed.items():
        settings[table] = settings.get(table, {}) | values
    if second_tracker is not None:
        axes = ("x_axis_body", "y_axis_body", "z_axis_body")
        turned = dict(zip(axes, ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), strict=True))
        own = {"name": "STARTRACKER_2", **turned, **second_tracker}
        settings["trackers"] = [*settings["trackers"], settings["trackers"][0] | own]
    return Mission.model_validate(settings)


@dataclass(frozen=True)
class Flown:
    """The batches of a pass, as they were sent, as they are read, and what is true of them."""

    sent: list
    batches: list
    truth: list


def flown(mission, sky, batches, seed, *, change=None, troubles=NO_TROUBLES, **wanted):
    """Fly a pass; `change` may alter each batch before it is sent."""
    drawn = list(draw_pass(mission, sky, Pass(batches, seed, troubles=troubles, **wanted)))
    sent = [each.batch for each in drawn]
    for body in sent:
        if change is not None:
            change(body)
    read = [submission_from_json(json.dumps(body)).batch for body in sent]
    return Flown(sent, read, [each.truth for each in drawn])


def evidence_from(mission, sky, batches):
    """What verified identification sees in the batches."""
    parts = []
    for number, batch in enumerate(batches):
        options = batch.options.__class__(identifier="verified")
        again = structs.replace(batch, options=options)
        parts.append(evidence_of(number, acquire(again, mission.within_zones, sky)))
    return merged(parts)


def advice_from(mission, sky, batches, **wanted):
    """The whole advice."""
    return advise(
        mission,
        batches,
        lambda batch: acquire(batch, mission.within_zones, sky),
        lambda batch: acquire(batch, mission, sky),
        **wanted,
    )


def near(found, truth):
    """Within the interval made twice as wide: but for one seed in ten thousand."""
    assert found is not None
    low, high = found.value - 2 * (found.value - found.low), None
    high = found.value + 2 * (found.high - found.value)
    return low <= truth <= high


def stars_of(body):
    return [star for each in body["observations"] for star in each["stars"]]


def percentile_99(values):
    return float(np.quantile(values, 0.99))
