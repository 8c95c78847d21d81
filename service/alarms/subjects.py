"""The subjects of limits: a quantity of a spacecraft, or of one of its trackers.

A subject is text, `residual_ratio` or `residual_ratio@STARTRACKER_2`: names of
quantities and of trackers have no `@`.
"""

from collections.abc import Callable, Mapping
from typing import Any

from service.alarms.limits import LimitSettings
from service.alarms.quantities import QUANTITIES
from service.missions.mission import Mission

Subject = str


def subject_of(quantity: str, tracker: str = "") -> Subject:
    """The subject that a quantity is; without a tracker, of the spacecraft as a whole."""
    return f"{quantity}@{tracker}" if tracker else quantity


def quantity_and_tracker(subject: Subject) -> tuple[str, str]:
    """The quantity and the tracker of a subject; the tracker is empty for the spacecraft's."""
    quantity, _, tracker = subject.partition("@")
    return quantity, tracker


def limited_trackers(mission: Mission) -> tuple[str, ...]:
    """The trackers that have limits of their own: all, where there are several."""
    if len(mission.trackers) == 1:
        return ()
    return tuple(each.name for each in mission.trackers)


def limits_of_subjects(
    mission: Mission, shipped: Mapping[str, LimitSettings], own: Mapping[Subject, LimitSettings]
) -> dict[Subject, LimitSettings]:
    """The limits of every subject of a mission, own ones in place of the shipped.

    A tracker without limits of its own has those of its spacecraft.
    """
    found = {name: own.get(name, settings) for name, settings in shipped.items()}
    for tracker in limited_trackers(mission):
        for name in shipped:
            if QUANTITIES[name].by_tracker:
                subject = subject_of(name, tracker)
                found[subject] = own.get(subject, found[name])
    return found


def sampler(subject: Subject) -> Callable[[Mapping[str, Any], Mapping[str, Any]], Any]:
    """The function that gives a result's sample of a subject, or None.

    It takes the result and, by tracker, the values of its trackers.
    """
    quantity, tracker = quantity_and_tracker(subject)
    sample_of = QUANTITIES[quantity].sample_of
    if not tracker:
        return lambda result, trackers: sample_of(result)
    return lambda result, trackers: sample_of(trackers[tracker]) if tracker in trackers else None
