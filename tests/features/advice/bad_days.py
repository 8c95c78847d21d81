"""Two days of spacecraft: the second one was bad for all but one, each for a cause of its own.

`python -m tests.features.advice.bad_days` serves them at port 8066 until interrupted, for a
person who does not know the causes: is ambiguity worse than yesterday, and why?
"""

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from service.app.factory import open_app
from service.missions.mission import SHIPPED_FOLDER, Mission, load_missions
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import DrawnBatch, draw_pass
from service.sky.model import SkyModel
from service.times import DAY_S, HOUR_S, Utc, bucket_start, parse_utc, shifted, utc_now
from service.vectors import matrix_from_quaternion
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.web.serving import Server, in_process_settings

PORT = 8066
FIELDS = 10
"""Number of fields of which the richest, or the poorest, is chosen for each batch."""
NEAR_COS = float(np.cos(np.radians(10.0)))
SECOND_TRACKER = """
[[trackers]]
name = "STARTRACKER_2"
x_axis_body = [0.0, 0.0, 1.0]
z_axis_body = [0.0, 1.0, 0.0]
field_of_view_radius_deg = 4.0
sigma_arcsec = 2.1213203
limit_mag = 6.5
"""
Body = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """A spacecraft, what differs on its second day, and the cause that the console shall name."""

    name: str
    cause: str = ""
    more: str = ""
    """Lines after those of the mission file."""
    drawn: Callable[[Mission], Mission] = lambda mission: mission
    """Mission by which the second day's batches are drawn."""
    served: Callable[[str], str] = lambda text: text
    """The mission file of the second day."""
    change: Callable[[Body], None] = lambda body: None
    is_dense: bool = False
    """True if the richest of several fields are seen on the second day, the poorest before."""
    wanted: tuple[tuple[str, Any], ...] = ()
    stars: int = 5


def noisy(mission: Mission) -> Mission:
    """A mission whose second tracker is ten times as noisy."""
    first, second = mission.trackers
    second = second.model_copy(update={"sigma_arcsec": 10.0 * second.sigma_arcsec})
    return mission.model_copy(update={"trackers": (first, second)})


def only_bright(body: Body) -> None:
    """Leave a tracker its two brightest stars."""
    for each in body["observations"]:
        each["stars"] = sorted(each["stars"], key=lambda star: star["magnitude"])[:2]


CASES = (
    Case("AURIGA"),
    Case("BOOTES", "STARTRACKER_2 is noisy.", more=SECOND_TRACKER, drawn=noisy),
    Case(
        "CEPHEUS", "STARTRACKER_1 has lost sensitivity: it reports fewer stars.", change=only_bright
    ),
    Case(
        "DORADO",
        "The zone was made larger: more stars of the catalog compete for each observed one.",
        served=lambda text: text.replace("radius_deg = 10.66", "radius_deg = 40.0"),
        stars=3,
    ),
    Case(
        "ERIDANUS",
        "STARTRACKER_1 looks at dense fields.",
        more="\n[tolerances]\nseparation_deg = 0.02\n",
        is_dense=True,
        stars=3,
    ),
    Case(
        "FORNAX",
        "The a priori attitude is worse than before.",
        wanted=(("a_priori_error_deg", 9.0),),
    ),
)


def mission_text(case: Case) -> str:
    """The mission file of the first day."""
    text = (
        (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8").replace('"XTE"', f'"{case.name}"')
    )
    return text.replace("[zone]", 'identifier = "starid"\n\n[zone]', 1) + case.more


def write_missions(folder: Path, is_second: bool) -> Path:
    """The mission files of all cases on a day."""
    folder.mkdir()
    for case in CASES:
        text = mission_text(case)
        text = case.served(text) if is_second else text
        (folder / f"{case.name.lower()}.toml").write_text(text, encoding="utf-8")
    return folder


def richness(mission: Mission, sky: SkyModel, drawn: DrawnBatch) -> int:
    """Number of catalog stars about the boresights of a batch."""
    attitude = matrix_from_quaternion(drawn.truth["quaternion"])
    stars = sky.run_catalog(mission, parse_utc(drawn.batch["time"])).direction
    axes = (each.boresight_body @ attitude for each in mission.trackers)
    return sum(int(np.count_nonzero(stars @ axis > NEAR_COS)) for axis in axes)


def bodies_of(
    case: Case, mission: Mission, sky: SkyModel, asked: Pass, is_second: bool
) -> list[Body]:
    """The batches of a day, drawn by the mission of the first day or as the case has it."""
    asked = replace(asked, stars=case.stars)
    if is_second:
        mission, asked = case.drawn(mission), replace(asked, **dict(case.wanted))
    seeds = range(asked.seed, asked.seed + (FIELDS if case.is_dense else 1))
    passes = [draw_pass(mission, sky, replace(asked, seed=10 * seed)) for seed in seeds]
    found = []
    for several in zip(*passes, strict=True):
        place = -1 if is_second else 0
        body = sorted(several, key=lambda each: richness(mission, sky, each))[place].batch
        body["batch"] = f"{case.name.lower()}-{body['time'][:16]}"
        if is_second:
            case.change(body)
        found.append(body)
    return found


@contextmanager
def two_days(folder: Path, end: Utc, batches: int, port: int = 0) -> Iterator[str]:
    """Address of a service with so many batches a day of every case; the second day has an end."""
    first = load_missions(write_missions(folder / "first", is_second=False))
    write_missions(folder / "second", is_second=True)
    database = sqlite_at(folder / "acquire.db")
    for is_second in (False, True):
        missions = folder / ("second" if is_second else "first")
        app = open_app(in_process_settings(database, missions=missions))
        start = shifted(end, -DAY_S * (1.0 if is_second else 2.0)).text
        asked = Pass(batches, 1 + is_second, start, DAY_S / batches, troubles=NO_TROUBLES)
        for case in CASES:
            bodies = bodies_of(case, first[case.name], app.sky, asked, is_second)
            sent = [submission_from_json(json.dumps(each)) for each in bodies]
            answers = app.submissions.submit_many(sent)
            assert not [each for each in answers if isinstance(each, Exception)]
        if not is_second:
            app.close()
    with Server(create_app(app), port) as address:
        yield address


def main() -> None:
    """Serve the cases until interrupted."""
    end = bucket_start(utc_now().bucket(HOUR_S), HOUR_S)
    with (
        tempfile.TemporaryDirectory() as folder,
        two_days(Path(folder), end, 72, PORT) as address,
        suppress(KeyboardInterrupt),
    ):
        print(f"{address} until Ctrl-C", flush=True)
        while True:
            time.sleep(1.0)


if __name__ == "__main__":
    main()
