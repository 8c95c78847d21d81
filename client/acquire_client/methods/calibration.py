"""Client methods: calibration."""
# Written by `make client` from service/features/calibration/routes.py.

from collections.abc import Sequence

from .. import models
from ..calls import Call, Listing, model, paged_list, single_request
from ..encoding import Time, parameters_of, path_of


class CalibrationMethods:
    """Methods for the routes of `service/features/calibration/routes.py` of the service."""

    @paged_list
    def calibrations(self, spacecraft: str | None = None) -> Listing[models.CalibrationSummary]:
        """Calibrations without covariances and residual maps, newest first.

        - `spacecraft`: Only items of this spacecraft.

        >>> [each.version for each in client.calibrations("XTE")]
        []
        """
        path = path_of("calibrations")
        query = {"spacecraft": spacecraft}
        return Listing(models.CalibrationSummary, path, query)

    @single_request
    def calibrate(
        self,
        spacecraft: str,
        *,
        start: Time | None = None,
        end: Time | None = None,
        run: str = "live",
        trackers: Sequence[str] = (),
        degree: int | None = None,
        alignment: bool = True,
        scale: bool = True,
        time_tag: bool = False,
        magnitudes: bool = True,
        who: str | None = None,
    ) -> Call[models.Calibration]:
        """Estimate alignment, scale and distortion of trackers; no setting is changed.

        - `start`: Start of the period, included.
        - `end`: End of the period, excluded.
        - `trackers`: The first is the reference; empty: all of the mission.
        - `degree`: Degree of the distortion; 0: none; None: the degree that fits held-out blocks
          of time best.
        - `alignment`: Estimate alignment between trackers.
        - `scale`: Estimate the scale of measured angles.
        - `time_tag`: Estimate how much later than sent stars were measured.
        - `magnitudes`: Estimate zero point, scale and colour term of magnitudes.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        """
        path = path_of("calibrations")
        body = {
            "spacecraft": spacecraft,
            "start": start,
            "end": end,
            "run": run,
            "trackers": trackers,
            "degree": degree,
            "alignment": alignment,
            "scale": scale,
            "time_tag": time_tag,
            "magnitudes": magnitudes,
            "who": who,
        }
        return Call(model(models.Calibration), "POST", path, body=parameters_of(body))

    @single_request
    def calibration(self, id: str) -> Call[models.Calibration]:
        """One calibration with covariance and residual maps.

        - `id`: The `id` of a calibration.
        """
        path = path_of("calibrations", id)
        return Call(model(models.Calibration), "GET", path)

    @single_request
    def adopt_calibration(
        self, id: str, *, who: str | None = None, note: str = ""
    ) -> Call[models.CalibrationAdoption]:
        """Process new batches of the spacecraft with a calibration from now on.

        - `id`: The `id` of a calibration.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        - `note`: The reason, in plain text.
        """
        path = path_of("calibrations", id, "adopt")
        body = {"who": who, "note": note}
        return Call(model(models.CalibrationAdoption), "POST", path, body=parameters_of(body))

    @single_request
    def calibration_in_force(self, spacecraft: str) -> Call[models.CalibrationInForce]:
        """The calibration in force for new batches of a spacecraft, and the history of adoptions.

        - `spacecraft`: The spacecraft's name, such as `XTE`.

        >>> in_force = client.calibration_in_force("XTE")
        >>> in_force.calibration, in_force.history
        (None, [])
        """
        path = path_of("spacecraft", spacecraft, "calibration")
        return Call(model(models.CalibrationInForce), "GET", path)

    @single_request
    def revert_calibration(
        self, spacecraft: str, to: str | None = None, *, who: str | None = None, note: str = ""
    ) -> Call[models.CalibrationAdoption]:
        """Return to an earlier adopted calibration, or to the mission file.

        - `spacecraft`: The spacecraft's name, such as `XTE`.
        - `to`: The `id` of an earlier adoption; None: the mission file.
        - `who`: Your name. Required while access is open; with a token, the service uses the
          token's name.
        - `note`: The reason, in plain text.
        """
        path = path_of("spacecraft", spacecraft, "calibration", "revert")
        body = {"to": to, "who": who, "note": note}
        return Call(model(models.CalibrationAdoption), "POST", path, body=parameters_of(body))
