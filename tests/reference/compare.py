"""The service's answers beside those of the plain implementation, star by star."""

import json
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, ClassVar

import msgspec
import numpy as np

from service.acquire import Acquisition, acquire
from service.identify.identification import MAX_RIVALS
from service.missions.mission import Mission
from service.observations.schema import submission_from_json
from service.sky.model import SkyModel
from service.sky.zones import Zone
from service.storage.recording.answer import answer_of
from service.times import parse_utc
from tests.reference import batches
from tests.reference.plain_starid import PlainCatalog, PlainOutcome, PlainZone, identify

Json = dict[str, Any]


@dataclass
class Comparison:
    """What was compared, by the outcome that the plain implementation gives, and what differed."""

    outcomes: Counter[str] = field(default_factory=Counter)
    differences: list[str] = field(default_factory=list)


def answered(batch: Json, mission: Mission, sky: SkyModel) -> Json:
    """The service's answer, by the way every batch takes: from its JSON text."""
    submission = submission_from_json(json.dumps(batch))
    return answer_as_json(acquire(submission.batch, mission, sky))


def answer_as_json(acquisition: Acquisition, id: str | None = None) -> Json:
    """An answer as a client reads it."""
    return dict(json.loads(msgspec.json.encode(answer_of(acquisition, id=id))))


def plain_view(answer: Json) -> list[list[PlainOutcome]]:
    """An answer's stars in the words of the plain implementation."""
    return [
        [
            PlainOutcome(
                star["outcome"],
                star["star"]["id"] if star["star"] else None,
                star["votes"],
                star["runner_up"],
                tuple(star.get("rivals", ())),
            )
            for star in tracker["stars"]
        ]
        for tracker in answer["observations"]
    ]


MOST_ZONES = 30
"""Kept of one catalog; a band takes some megabytes."""


class Judge:
    """Holds the service against the plain implementation, for one mission.

    Judges share catalogs and zones: those of one seed meet the same a priori attitudes.
    """

    _catalogs: ClassVar[dict[tuple[str, float], PlainCatalog]] = {}
    _zones: ClassVar[dict[int, dict[Any, PlainZone]]] = {}

    def __init__(self, toml: Json, sky: SkyModel) -> None:
        self.toml, self.sky = toml, sky
        self.mission = Mission.model_validate(toml)
        self.comparison = Comparison()

    def catalog(self, time: str) -> PlainCatalog:
        """The run catalog of a time, as it would be exported."""
        run = self.sky.run_catalog(self.mission, parse_utc(time))
        key = (json.dumps(self.toml["catalog"]), run.epoch_year)
        if key not in self._catalogs:
            self._catalogs[key] = PlainCatalog(
                list(run.star_id), run.ra_deg, run.dec_deg, run.magnitude_mag
            )
        return self._catalogs[key]

    def hold(self, batch: Json) -> Json:
        """Compare one batch; what differs is noted.  Gives back the service's answer."""
        catalog = self.catalog(batch["time"])
        zones = self._zones.setdefault(id(catalog), {})
        if len(zones) > MOST_ZONES:
            zones.clear()
        expected = identify(batch, self.toml, catalog, zones)
        answer = answered(batch, self.mission, self.sky)
        for tracker, (got, right) in enumerate(zip(plain_view(answer), expected, strict=True)):
            for k, (one, other) in enumerate(zip(got, right, strict=True)):
                cut = PlainOutcome(
                    other.outcome,
                    other.star_id,
                    other.votes,
                    other.runner_up,
                    other.rivals[:MAX_RIVALS],
                )
                self.comparison.outcomes[other.outcome] += 1
                if one != cut:
                    place = f"{batch['spacecraft']} {batch['batch']} tracker {tracker} star {k}"
                    self.comparison.differences.append(f"{place}: {one} instead of {cut}")
        return answer

    def hold_many(self, rng: np.random.Generator, count: int, **fixed: Any) -> Comparison:
        """Compare random batches; ten share an a priori attitude, so that zones are met again."""
        attitudes = batches.prior_attitudes(rng, self.toml, max(3, count // 10))
        for number in range(count):
            time = fixed.get("time", batches.TIMES[rng.integers(len(batches.TIMES))])
            attitude = attitudes[rng.integers(len(attitudes))]
            drawn = {**fixed, "time": time}
            self.hold(
                batches.draw_batch(rng, self.toml, self.catalog(time), attitude, number, **drawn)
            )
        return self.comparison


def zone_searched(found: Acquisition, sky: SkyModel) -> Zone:
    """The zone that the stars of an acquisition's first tracker were searched in."""
    region, choices = found.trackers[0].region, found.choices
    assert region is not None
    zone, _ = sky.zone(
        found.mission,
        found.run_catalog,
        region,
        choices.tolerances.pair_separation_max_deg,
        choices.zone_grid_deg,
    )
    return zone
