"""The trackers of one batch side by side, as its answer gives them."""

from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.calibrate import correct
from service.sky.model import SkyModel
from service.storage.models.answers import Answer
from service.storage.recording.tracker_values import Row, catalog_rows, tracker_rows


def tracker_comparison(
    batch: ObservationBatch, mission: Mission, sky: SkyModel, answer: Answer
) -> list[Row]:
    """A row of `tracker_values` for each tracker, with its sigma as the mission has it.

    Offsets from the catalog are not known where the answer's run catalog is no longer there.
    """
    run_catalog = sky.run_catalog(mission, batch.time)
    place: dict[str, int] = {}
    if run_catalog.digest == answer.provenance.run_catalog:
        place = {id: row for row, id in enumerate(run_catalog.star_id)}
    corrected = correct(batch, mission)
    star = catalog_rows(answer, place)
    rows = tracker_rows(answer.id or "", answer, batch, corrected, run_catalog, star)
    return [
        row | {"sigma_arcsec": each.tracker.sigma_arcsec}
        for row, each in zip(rows, corrected, strict=True)
    ]
