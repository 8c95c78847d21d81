"""Simulated telemetry: a pass drawn from the real sky, with its truth.

Stars are at their places at the batch's own time, seen from the spacecraft's position and with its
velocity; of the service's catalog only the names of stars are used.  The truth is kept next to the
batch and never enters it.

A pass may include a gyro: its samples in blocks, with realistic errors.  Between two batches the
body turns at a constant rate from one true attitude to the next.  The gyro integrates that rate
about its axes: it has a bias that walks, noise, errors of scale and alignment (Farrenkopf's model),
counts whole steps of angle, may fall silent, and its clock, which is also that of the trackers, may
step.
"""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO, cast

import numpy as np

from service import vectors
from service.errors import BadFile, BadInput, Fault, shown_value
from service.missions.mission import Band, Mission
from service.missions.motion import GyroSettings
from service.observations.batch import Aberration
from service.observations.csv_rows import write_batches_csv
from service.observations.input_formats import CSV, telemetry_format
from service.observations.schema import BatchIn
from service.simulate import motion
from service.simulate.sightings import BatchScene, Seen, real_sky
from service.simulate.stretches import Pass
from service.sky.ephemeris import observer_velocity, sun_direction
from service.sky.model import SkyModel
from service.times import Utc, parse_utc, shifted
from service.vectors import ARCSEC_PER_RADIAN, Vector, rotation_vectors


@dataclass(frozen=True)
class DrawnBatch:
    """A simulated batch as sent to the service, and its truth; both ready for JSON.

    `gyro` are gyro blocks that are sent with it.
    """

    batch: dict[str, Any]
    truth: dict[str, Any]
    gyro: Sequence[dict[str, Any]] = ()


def draw_pass(mission: Mission, sky: SkyModel, wanted: Pass) -> Iterator[DrawnBatch]:
    """Simulate the batches of a pass, in order of time.

    Every batch has its own random generator, so that changing one leaves the others unchanged; the
    mission's name is part of the seed.
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
            noise_arcsec=wanted.noise_arcsec,
            false_stars=wanted.false_stars,
            missing_share=wanted.missing_share,
        )
        error_deg = wanted.error_deg_of(mission)
        if isinstance(state, float):
            sun = sun_direction(time, position_km)
            attitude, presumed, seen = _on_the_sun(scene, sun, state, error_deg, wanted.stars)
        else:
            attitude, presumed, seen = _on_the_sky(scene, state, drift, error_deg, wanted.stars)
        by_direction = wanted.prior == "direction" or (
            wanted.prior == "mixed" and bool(rng.random() < 0.5)
        )
        as_angles = bool(rng.random() < wanted.angles_share)
        batch = {
            "spacecraft": mission.name,
            "batch": f"{time.text[:4]}-{time.day_of_year:03d}-{k + 1:0{digits}d}",
            "time": time.text,
            "a_priori": (
                None if wanted.prior == "none" else _prior(mission, presumed, by_direction)
            ),
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


def outside_zone(mission: Mission, drawn: DrawnBatch) -> bool:
    """True if a field of view of the batch extends beyond the zone about the a priori attitude.

    Stars outside of the zone cannot be identified in it.
    """
    prior, zone = drawn.batch["a_priori"], mission.zone
    if prior is None:
        return False
    off_deg = [drawn.truth["a_priori_axis_error_deg"]] * len(mission.trackers)
    if isinstance(zone, Band):
        size_deg = zone.half_width_deg
    else:
        size_deg = zone.radius_deg
        if "quaternion" in prior:
            presumed = vectors.matrix_from_quaternion(prior["quaternion"])
            attitude = vectors.matrix_from_quaternion(drawn.truth["quaternion"])
            off_deg = [
                float(vectors.angle_between_deg(b @ presumed, b @ attitude))
                for b in (tracker.boresight_body for tracker in mission.trackers)
            ]
    return any(
        off + tracker.field_of_view_radius_deg > size_deg
        for off, tracker in zip(off_deg, mission.trackers, strict=True)
    )


def _motion(
    mission: Mission, rates: vectors.Vector, cadence_s: float, rng: np.random.Generator
) -> Iterable[vectors.Matrix | float]:
    """Attitude of each batch by its rates, or for a Sun-pointed mission the roll (rad) of each."""
    if isinstance(mission.zone, Band):
        steps_rad = np.radians(rates @ mission.axis_body) * cadence_s
        rolls_rad: list[float] = (
            rng.uniform(0.0, math.tau) + np.cumsum(steps_rad) - steps_rad
        ).tolist()
        return rolls_rad
    first = motion.pointed(mission.axis_body, motion.random_axis(rng), rng.uniform(0.0, math.tau))
    return motion.slewing_attitudes(rates, cadence_s, first)


def _on_the_sun(
    scene: BatchScene, sun: vectors.Vector, roll_rad: float, limit: float, most: int
) -> tuple[vectors.Matrix, vectors.Matrix, list[Seen]]:
    """Attitude with a pole near the Sun, an a priori one with it on the Sun, and the stars seen."""
    rng, stretch, axis = scene.rng, scene.stretch, scene.mission.axis_body
    tilt_deg = rng.uniform(0.0, limit)
    if stretch.kind == "attitude_error":
        tilt_deg = limit + (stretch.size - limit) * stretch.progress
    pole = motion.tilted(sun, math.radians(tilt_deg), rng)
    attitude, seen = scene.look(motion.pointed(axis, pole, roll_rad), most)
    return attitude, _as_sent(motion.pointed(axis, sun, rng.uniform(0.0, math.tau))), seen


def _on_the_sky(
    scene: BatchScene,
    attitude: vectors.Matrix,
    drift: vectors.Vector,
    limit: float,
    most: int,
) -> tuple[vectors.Matrix, vectors.Matrix, list[Seen]]:
    """A batch's attitude, an a priori one with an error about each axis, and the stars seen."""
    rng, stretch = scene.rng, scene.stretch
    attitude, seen = scene.look(attitude, most)
    angles = rng.uniform(-limit, limit, 3)
    if stretch.kind == "attitude_error":
        angles = drift * (limit + (stretch.size - limit) * stretch.progress)
    psi, theta, phi = angles
    error = vectors.coordinate_rotation(0, psi) @ vectors.coordinate_rotation(1, theta)
    error = error @ vectors.coordinate_rotation(2, phi)
    return attitude, _as_sent(error.T @ attitude), seen


def _as_sent(attitude: vectors.Matrix) -> vectors.Matrix:
    """Attitude matrix after rounding its quaternion as in the batch sent."""
    return vectors.matrix_from_quaternion(
        vectors.unit(np.round(vectors.quaternion_from_matrix(attitude), 10))
    )


def _rounded(time: Utc) -> Utc:
    """Time rounded to the millisecond, as sent."""
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
        "a_priori_error_deg": (
            error_deg.tolist() if "quaternion" in (batch["a_priori"] or ()) else None
        ),
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
    """Path of the truth of a telemetry file: OUT.truth.ndjson next to OUT.ndjson."""
    return telemetry.with_name(f"{telemetry.stem}.truth.ndjson")


def write_pass(drawn: Iterable[DrawnBatch], telemetry: Path) -> int:
    """Write simulated batches (NDJSON, or CSV by file name) and their truth; returns their number.

    NDJSON also gets the gyro blocks, each after its batch.  Both files appear when complete: an
    interrupted pass leaves the old ones.
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
        if telemetry_format(telemetry) == CSV:
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
    """JSON objects of a trusted NDJSON file, one per line."""
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


SAMPLES_OF_A_BLOCK = 1_000
GAP_AT, CLOCK_STEP_AT = 0.4, 0.7
"""Shares of the pass at which a gyro gap begins and the clock steps."""
_DIGITS = 12
"""Decimals of a rate in rad/s: far below the noise of any gyro."""


@dataclass(frozen=True)
class GyroWanted:
    """Sampling and faults of a simulated gyro; the mission gives its noise."""

    step_s: float = 1.0
    quantum_arcsec: float = 0.0
    gap_s: float = 0.0
    clock_step_s: float = 0.0

    def __post_init__(self) -> None:
        for name, least, most in (
            ("step_s", 0.01, 3600.0),
            ("quantum_arcsec", 0.0, 3600.0),
            ("gap_s", 0.0, 86_400.0),
            ("clock_step_s", 0.0, 3600.0),
        ):
            value = getattr(self, name)
            if not least <= value <= most:
                message = f"must be from {least:g} to {most:g}"
                raise BadInput(Fault(f"gyro {name}", message, shown_value(value)))


def with_gyro(
    drawn: Iterable[DrawnBatch], mission: Mission, wanted: GyroWanted, duration_s: float, seed: int
) -> Iterator[DrawnBatch]:
    """Add gyro blocks to the batches of a pass, to each those that have ended by then.

    Raises `BadInput` for a mission that does not describe its gyro.
    """
    if mission.gyro is None:
        message = "its mission file has no table [gyro], which names the noise"
        raise BadInput(Fault("gyro", message, mission.name))
    gyro = _Gyro(mission.name, mission.gyro, wanted, duration_s, seed)
    before: DrawnBatch | None = None
    for each in drawn:
        if before is None:
            gyro.begin(each)
        else:
            gyro.turn(before, each)
        if before is not None:
            yield replace(gyro.by_its_clock(before), gyro=gyro.full_blocks())
        before = each
    if before is not None:
        yield replace(gyro.by_its_clock(before), gyro=[*gyro.full_blocks(), *gyro.rest()])


class _Gyro:
    """Simulated gyro: its error state, and the samples that are not in a block yet.

    Times are seconds since the first batch, by a true clock.
    """

    def __init__(
        self,
        spacecraft: str,
        settings: GyroSettings,
        wanted: GyroWanted,
        duration_s: float,
        seed: int,
    ) -> None:
        self._spacecraft, self._settings, self._wanted = spacecraft, settings, wanted
        rng = self._rng = np.random.default_rng([seed, *spacecraft.encode(), 2])
        self._gap = GAP_AT * duration_s, GAP_AT * duration_s + wanted.gap_s
        self._stepped_at = CLOCK_STEP_AT * duration_s
        self._bias = rng.normal(0.0, settings.bias_sigma_rad_s, 3)
        errors = rng.normal(0.0, settings.misalignment_arcsec / ARCSEC_PER_RADIAN, (3, 3))
        np.fill_diagonal(errors, rng.normal(0.0, settings.scale, 3))
        self._measured_from_true = np.eye(3) + errors
        self._gyro_from_body = np.linalg.inv(settings.body_from_gyro)
        self._angle = np.zeros(3)
        self._counted = np.zeros(3)
        self._turned = np.zeros(3)
        self._samples = 0
        self._at_s = 0.0
        self._start: Utc | None = None
        self._block: list[list[float]] = []
        self._block_start_s = 0.0
        self._blocks: list[dict[str, Any]] = []

    def begin(self, first: DrawnBatch) -> None:
        """Set the start of the simulation to the time of the first batch."""
        self._start = parse_utc(first.truth["time"])

    def turn(self, before: DrawnBatch, after: DrawnBatch) -> None:
        """Sample the body's rotation from one batch to the next, as the gyro does."""
        quaternions = np.array([each.truth["quaternion"] for each in (before, after)])
        times = [parse_utc(each.truth["time"]).tai_ns for each in (before, after)]
        assert self._start is not None
        end_s = (times[1] - self._start.tai_ns) * 1e-9
        rate = rotation_vectors(*quaternions) / ((times[1] - times[0]) * 1e-9)
        while (next_s := self._samples * self._wanted.step_s) <= end_s + 1e-9:
            self._turned += rate * (next_s - self._at_s)
            # The first sample is of a step before the pass, at the same rate.
            step = rate * self._wanted.step_s if self._samples == 0 else self._turned
            self._sample(next_s, step)
            self._at_s, self._turned = next_s, np.zeros(3)
        self._turned += rate * (end_s - self._at_s)
        self._at_s = end_s

    def by_its_clock(self, batch: DrawnBatch) -> DrawnBatch:
        """Batch with its time by the spacecraft clock, which may have stepped."""
        assert self._start is not None
        true = parse_utc(batch.truth["time"])
        later_s = self._later_s((true.tai_ns - self._start.tai_ns) * 1e-9)
        if not later_s:
            return batch
        time = shifted(true, later_s).text
        return replace(
            batch, batch=batch.batch | {"time": time}, truth=batch.truth | {"time": time}
        )

    def full_blocks(self) -> list[dict[str, Any]]:
        """Gyro blocks finished since the last call."""
        blocks, self._blocks = self._blocks, []
        return blocks

    def rest(self) -> list[dict[str, Any]]:
        """Finish the last gyro block, and return it with all not returned yet."""
        self._end_block()
        return self.full_blocks()

    def _sample(self, at_s: float, turned: Vector) -> None:
        """Add a sample of the rotation (3,) since the last one, in radians about the body axes."""
        step_s, settings = self._wanted.step_s, self._settings
        walk = self._rng.normal(0.0, settings.sigma_u_rad_s1_5 * step_s**0.5, 3)
        mean_bias = self._bias + 0.5 * walk
        self._bias = self._bias + walk
        sigma_rad = (
            settings.sigma_v_rad_s0_5**2 * step_s + settings.sigma_u_rad_s1_5**2 * step_s**3 / 12.0
        ) ** 0.5
        noise = self._rng.normal(0.0, sigma_rad, 3)
        self._angle += self._measured_from_true @ turned + mean_bias * step_s + noise
        counted = self._gyro_from_body @ self._angle
        if quantum := self._wanted.quantum_arcsec / ARCSEC_PER_RADIAN:
            counted = np.floor(counted / quantum) * quantum
        rate, self._counted = (counted - self._counted) / step_s, counted
        self._samples += 1
        is_silent = self._wanted.gap_s and self._gap[0] < at_s < self._gap[1]
        # A block has one step: it ends at a gap, and where the clock steps.
        steps_now = self._later_s(at_s) != self._later_s(at_s - step_s)
        if is_silent or steps_now or len(self._block) == SAMPLES_OF_A_BLOCK:
            self._end_block()
        if is_silent:
            return
        if not self._block:
            self._block_start_s = at_s
        self._block.append(np.round(rate, _DIGITS).tolist())

    def _end_block(self) -> None:
        if not self._block:
            return
        assert self._start is not None
        start = shifted(self._start, self._block_start_s + self._later_s(self._block_start_s))
        self._blocks.append(
            {
                "spacecraft": self._spacecraft,
                "block": f"{start.text[:4]}-{start.day_of_year:03d}-{start.text[11:]}",
                "start": start.text,
                "step_s": self._wanted.step_s,
                "rates_rad_per_s": self._block,
            }
        )
        self._block = []

    def _later_s(self, at_s: float) -> float:
        """Offset of the spacecraft clock from true time, in seconds."""
        return self._wanted.clock_step_s if at_s >= self._stepped_at else 0.0
