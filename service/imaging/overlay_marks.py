"""What an overlay shows of each star: where it is, what it was taken for, how far it is off."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.missions.camera import Camera
from service.missions.mission import Tracker
from service.observations.batch import ObservationBatch
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import apparent, observer_velocity
from service.vectors import matrix_from_quaternion


@dataclass(frozen=True)
class Mark:
    """A place on a frame, in its pixels.

    `kind` is the star's outcome, `left_out` for one that is in no batch, or `sharp` for
    a hot pixel or cosmic ray.  `predicted_px` is where the catalog and the attitude have
    the star, None where either is missing.
    """

    u_px: float
    v_px: float
    kind: str
    label: str = ""
    predicted_px: tuple[float, float] | None = None


def marks_of(
    answer: Any,
    batch: ObservationBatch,
    tracker: Tracker,
    camera: Camera,
    detections: Mapping[str, Any],
    run_catalog: RunCatalog | None,
) -> list[Mark]:
    """The marks of a recorded `Answer`; without a run catalog no star has a predicted place."""
    found = [star for star in detections["stars"] if star["u_px"] is not None]
    used = [star for star in found if star["used"]]
    told = next(each.stars for each in answer.observations if each.tracker == tracker.name)
    names = [None if each.star is None else str(each.star.id) for each in told]
    predicted = _predicted(names, answer, batch, tracker, camera, run_catalog)
    marks = [
        Mark(
            star["u_px"],
            star["v_px"],
            each.outcome,
            name or "",
            place if each.outcome == "unique" else None,
        )
        for star, each, name, place in zip(used, told, names, predicted, strict=True)
    ]
    marks += [Mark(star["u_px"], star["v_px"], "left_out") for star in found if not star["used"]]
    return marks + [Mark(u, v, "sharp") for u, v in detections["hot_or_cosmic_px"]]


def _predicted(
    names: Sequence[str | None],
    answer: Any,
    batch: ObservationBatch,
    tracker: Tracker,
    camera: Camera,
    run_catalog: RunCatalog | None,
) -> list[tuple[float, float] | None]:
    attitude = answer.attitude
    # Without a calibration the lens that was fitted to the frame is not known any more.
    if attitude is None or run_catalog is None or not camera.calibrated:
        return [None] * len(names)
    wanted = set(names)
    rows = {name: row for row, name in enumerate(run_catalog.star_id) if name in wanted}
    row = np.array([-1 if name is None else rows.get(name, -1) for name in names])
    direction = run_catalog.direction_at(batch.time)[row]
    if batch.aberration == "to_correct":
        velocity_c = observer_velocity(batch.time, batch.velocity_km_per_s)
        direction = apparent(direction, velocity_c, batch.time)
    body = direction @ matrix_from_quaternion(attitude.quaternion).T
    u, v = camera.places(body @ tracker.body_from_tracker)
    return [
        (at_u, at_v) if known >= 0 and np.isfinite(at_u) else None
        for known, at_u, at_v in zip(row.tolist(), u.tolist(), v.tolist(), strict=True)
    ]
