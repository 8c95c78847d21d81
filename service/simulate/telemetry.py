"""Sample telemetry: a pass drawn from the real sky, with its truth.

The stars stand where they are at the batch's own time, seen from where the
spacecraft is and with its speed; how the service knows them is another matter,
and only their names are its own.  The truth is kept beside the batch and never
enters it.
"""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO, cast

import numpy as np

from service import vectors
from service.errors import BadFile, Fault
from service.missions.mission import Band, Mission
from service.observations.batch import Aberration
from service.observations.readers.csv_rows import write_batches_csv
from service.observations.readers.telemetry import telemetry_format
from service.observations.schema import BatchIn
from service.simulate import motion
from service.simulate.sightings import BatchScene, Seen, real_sky
from service.simulate.stretches import Pass
from service.sky.ephemeris import observer_velocity, sun_direction
from service.sky.model import SkyModel
from service.times import Utc, parse_utc, shifted

CAP_A_PRIORI_DEG = 3.0
BAND_A_PRIORI_DEG = 0.1


@dataclass(frozen=True)
class DrawnBatch:
    """One batch as it is sent, and what is true of it; both ready for JSON.

    `gyro` are gyro blocks that are sent with it.
    """

    batch: dict[str, Any]
    truth: dict[str, Any]
    gyro: Sequence[dict[str, Any]] = ()


def draw_pass(mission: Mission, sky: SkyModel, wanted: Pass) -> Iterator[DrawnBatch]:
    """The batches of a pass, in order of time.

    Every batch has a random generator of its own, so that a change of one
    leaves the others as they were; the mission's name makes its pass another
    than that of its sister with the same seed.
    """
    start, cadence_s = parse_utc(wanted.start_of(mission), "start"), wanted.cadence_of(mission)
    root = (wanted.seed, *mission.name.encode())
    rng = np.random.default_rng([*root, 0])
    rates = motion.body_rates_deg_per_s(mission, wanted.batches, rng)
    drift = rng.uniform(-1.0, 1.0, 3)
    drift /= np.abs(drift).max()
    states = _motion(mission, rates, cadence_s, rng)
    words, shares = zip(*wanted.aberration.items(), strict=True)
    orbit = motion.orbit_of(mission)
    digits = max(4, len(str(wanted.batches)))
    for k, (stretch, state) in enumerate(zip(wanted.stretches(mission), states, strict=True)):
        time = _rounded(shifted(start, k * cadence_s))
        rng = np.random.default_rng([*root, 1, k])
        position_km, velocity_km_per_s = (np.round(each, 4) for each in orbit.state(time))
        scene = BatchScene(
            mission=mission,
            sky=real_sky(sky.catalog, mission.run_catalog_settings, sky.run_catalog(mission, time)),
            time=time,
            position_km=position_km,
            velocity_c=observer_velocity(time, velocity_km_per_s),
            aberration=cast(Aberration, str(rng.choice(words, p=shares))),
            rates_deg_per_s=rates[k],
            stretch=stretch,
            rng=rng,
        )
        if isinstance(state, float):
            sun = sun_direction(time, position_km)
            attitude, presumed, seen = _on_the_sun(scene, sun, state, wanted.stars)
        else:
            attitude, presumed, seen = _on_the_sky(scene, state, drift, wanted.stars)
        by_direction = wanted.prior == "direction" or (
            wanted.prior == "mixed" and bool(rng.random() < 0.5)
        )
        as_angles = bool(rng.random() < wanted.angles_share)
        batch = {
            "spacecraft": mission.name,
            "batch": f"{time.text[:4]}-{time.day_of_year:03d}-{k + 1:0{digits}d}",
            "time": time.text,
            "a_priori": _prior(mission, presumed, by_direction),
            "body_rates_deg_per_s": rates[k].tolist(),
            "velocity_km_per_s": velocity_km_per_s.tolist(),
            "position_km": position_km.tolist(),
            "aberration": scene.aberration,
            "observations": [
                {"tracker": each.tracker.name, "stars": scene.measured(each, as_angles)}
                for each in seen
            ],
        }
        yield DrawnBatch(batch, _truth(batch, scene, attitude, presumed, seen))


def _motion(
    mission: Mission, rates: vectors.Vector, cadence_s: float, rng: np.random.Generator
) -> Iterable[vectors.Matrix | float]:
    """The motion of each batch by its rates: the attitude, or the roll about a pole on the Sun."""
    if isinstance(mission.zone, Band):
        steps_rad = np.radians(rates @ mission.axis_body) * cadence_s
        rolls_rad: list[float] = (
            rng.uniform(0.0, math.tau) + np.cumsum(steps_rad) - steps_rad
        ).tolist()
        return rolls_rad
    first = motion.pointed(mission.axis_body, motion.random_axis(rng), rng.uniform(0.0, math.tau))
    return motion.slewing_attitudes(rates, cadence_s, first)


def _on_the_sun(
    scene: BatchScene, sun: vectors.Vector, roll_rad: float, most: int
) -> tuple[vectors.Matrix, vectors.Matrix, list[Seen]]:
    """A pole close to the Sun; the a priori attitude has it on the Sun, with any roll."""
    rng, stretch, axis = scene.rng, scene.stretch, scene.mission.axis_body
    tilt_deg = rng.uniform(0.0, BAND_A_PRIORI_DEG)
    if stretch.kind == "attitude_error":
        tilt_deg = BAND_A_PRIORI_DEG + (stretch.size - BAND_A_PRIORI_DEG) * stretch.progress
    pole = motion.tilted(sun, math.radians(tilt_deg), rng)
    attitude, seen = scene.look(motion.pointed(axis, pole, roll_rad), most)
    return attitude, _as_sent(motion.pointed(axis, sun, rng.uniform(0.0, math.tau))), seen


def _on_the_sky(
    scene: BatchScene, attitude: vectors.Matrix, drift: vectors.Vector, most: int
) -> tuple[vectors.Matrix, vectors.Matrix, list[Seen]]:
    """Anywhere; the a priori attitude is off: attitude = R1(psi) R2(theta) R3(phi) a priori."""
    rng, stretch, limit = scene.rng, scene.stretch, CAP_A_PRIORI_DEG
    attitude, seen = scene.look(attitude, most)
    angles = rng.uniform(-limit, limit, 3)
    if stretch.kind == "attitude_error":
        angles = drift * (limit + (stretch.size - limit) * stretch.progress)
    psi, theta, phi = angles
    error = vectors.coordinate_rotation(0, psi) @ vectors.coordinate_rotation(1, theta)
    error = error @ vectors.coordinate_rotation(2, phi)
    return attitude, _as_sent(error.T @ attitude), seen


def _as_sent(attitude: vectors.Matrix) -> vectors.Matrix:
    """The attitude of the quaternion as it is written."""
    return vectors.matrix_from_quaternion(
        vectors.unit(np.round(vectors.quaternion_from_matrix(attitude), 10))
    )


def _rounded(time: Utc) -> Utc:
    """The time to the millisecond, as it is sent."""
    nanoseconds = round(float(time.text[19:-1]) * 1e3) * 1_000_000
    whole = parse_utc(time.text[:19])
    return shifted(whole, nanoseconds * 1e-9) if nanoseconds else whole


def _prior(mission: Mission, presumed: vectors.Matrix, by_direction: bool) -> dict[str, Any]:
    if not by_direction:
        quaternion = np.round(vectors.quaternion_from_matrix(presumed), 10)
        return {"quaternion": quaternion.tolist(), "frame": "EME2000"}
    if isinstance(mission.zone, Band):
        return {"sun_pointed": True}
    ra_deg, dec_deg = vectors.to_ra_dec(presumed.T @ mission.axis_body)
    return {"boresight": {"ra_deg": round(float(ra_deg), 8), "dec_deg": round(float(dec_deg), 8)}}


def _truth(
    batch: dict[str, Any],
    scene: BatchScene,
    attitude: vectors.Matrix,
    presumed: vectors.Matrix,
    seen: list[Seen],
) -> dict[str, Any]:
    axis = scene.mission.axis_body
    error_deg = vectors.attitude_error_arcsec(presumed, attitude) / 3600.0
    return {
        "spacecraft": batch["spacecraft"],
        "batch": batch["batch"],
        "time": batch["time"],
        "stretch": scene.stretch.kind,
        "quaternion": vectors.quaternion_from_matrix(attitude).tolist(),
        "a_priori_error_deg": error_deg.tolist() if "quaternion" in batch["a_priori"] else None,
        "a_priori_axis_error_deg": float(
            vectors.angle_between_deg(presumed.T @ axis, attitude.T @ axis)
        ),
        "observations": [
            {
                "tracker": each.tracker.name,
                "stars": [None if row < 0 else scene.sky.run.star_id[row] for row in each.star],
            }
            for each in seen
        ],
    }


def truth_path(telemetry: Path) -> Path:
    """The truth of a telemetry file: OUT.truth.ndjson beside OUT.ndjson."""
    return telemetry.with_name(f"{telemetry.stem}.truth.ndjson")


def write_pass(drawn: Iterable[DrawnBatch], telemetry: Path) -> int:
    """Write batches (NDJSON, or CSV by the name) and their truth; how many there were.

    NDJSON also gets the gyro blocks, each after its batch.
    Both files appear when they are whole: a pass cut short leaves the old ones.
    """
    count = 0

    def truth_written() -> Iterator[DrawnBatch]:
        nonlocal count
        for each in drawn:
            truth.write(_line(each.truth))
            count += 1
            yield each

    with ExitStack() as stack:
        truth = stack.enter_context(_appearing(truth_path(telemetry)))
        out = stack.enter_context(_appearing(telemetry))
        if telemetry_format(telemetry) == "csv":
            write_batches_csv(
                (BatchIn.model_validate_json(json.dumps(each.batch)) for each in truth_written()),
                out,
            )
        else:
            out.writelines(
                _line(line) for each in truth_written() for line in (each.batch, *each.gyro)
            )
    return count


def read_objects(path: Path) -> Iterator[dict[str, Any]]:
    """The JSON objects of a file of the service's own making, one a line."""
    with path.open("rb") as file:
        for line in file:
            yield json.loads(line)


def _line(thing: dict[str, Any]) -> str:
    return json.dumps(thing, separators=(",", ":")) + "\n"


@contextmanager
def _appearing(path: Path) -> Iterator[TextIO]:
    part = path.with_name(path.name + ".part")
    try:
        with part.open("w", encoding="utf-8", newline="") as file:
            yield file
        part.replace(path)
    except OSError as error:
        raise BadFile(Fault(str(path), f"cannot be written: {error.strerror}")) from None
    finally:
        part.unlink(missing_ok=True)
