"""The acquisition of an attitude that a tracker measured itself: nothing is identified."""

import numpy as np

from service.attitude.solution import AttitudeSolution
from service.missions.mission import Mission
from service.observations.batch import MeasuredAttitude
from service.vectors import matrix_from_quaternion, quaternion_from_matrix, read_only

METHOD = "measured"
_UNKNOWN = np.nan


def measured_solution(measured: MeasuredAttitude, mission: Mission) -> AttitudeSolution:
    """The attitude of the body that a tracker measured, with its covariance about the body axes.

    With the alignment body = B @ tracker it is B A, and the covariance B P B^T.  There are no
    residuals: they, and what they would tell, are NaN.  Raises `BadInput` naming the field
    for a tracker that the mission has not.
    """
    attitude = matrix_from_quaternion(measured.quaternion)
    covariance = measured.covariance_arcsec2
    if measured.tracker is not None:
        turn = mission.tracker(measured.tracker, "measurement.tracker").body_from_tracker
        attitude, covariance = turn @ attitude, turn @ covariance @ turn.T
        covariance = 0.5 * (covariance + covariance.T)
    return AttitudeSolution(
        quaternion=read_only(quaternion_from_matrix(attitude)),
        matrix=read_only(attitude),
        method=METHOD,
        covariance_arcsec2=read_only(covariance),
        residual_arcsec=np.empty(0),
        residual_rms_arcsec=_UNKNOWN,
        predicted_rms_arcsec=_UNKNOWN,
        taste=_UNKNOWN,
        degrees_of_freedom=0,
        suspect=False,
        triad=np.full(4, _UNKNOWN),
        quest=np.full(4, _UNKNOWN),
        triad_quest_angle_arcsec=_UNKNOWN,
        trackers=(),
    )
