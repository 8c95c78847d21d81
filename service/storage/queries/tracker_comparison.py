"""The trackers of one batch side by side, as its answer gives them."""

import numpy as np

from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.calibrate import correct
from service.sky.model import SkyModel
from service.storage.models.answers import Answer
from service.storage.recording.tracker_values import Row, tracker_rows


def tracker_comparison(
    batch: ObservationBatch, mission: Mission, sky: SkyModel, answer: Answer
) -> list[Row]:
    """A row of `tracker_values` for each tracker, with its sigma as the mission has it.

    Magnitude offsets are not known where the answer's run catalog is no longer there.
    """
    run_catalog = sky.run_catalog(mission, batch.time)
    known: dict[str, float] = {}
    if run_catalog.digest == answer.provenance.run_catalog:
        pairs = zip(run_catalog.star_id, run_catalog.magnitude_mag.tolist(), strict=True)
        known = dict(pairs)
    magnitudes = [
        np.array([known.get(star.star.id, np.nan) if star.star else np.nan for star in each.stars])
        for each in answer.observations
    ]
    corrected = correct(batch, mission)
    rows = tracker_rows(answer.id or "", answer, corrected, magnitudes)
    return [
        row | {"sigma_arcsec": each.tracker.sigma_arcsec}
        for row, each in zip(rows, corrected, strict=True)
    ]
