"""Which unknowns the stars do not show, and why."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.calibration.elimination import Normal
from service.calibration.unknowns import Kind, Unknown, largest_sigma
from service.missions.mission import Tracker
from service.vectors import Matrix

Marks = npt.NDArray[np.bool_]

LEAST_SHARE = 1e-9
"""Of an unknown's information, what attitudes and other unknowns must leave of it."""

ORDER: tuple[Kind, ...] = ("alignment", "scale", "distortion", "temperature", "time_tag")
"""Of unknowns that the stars do not tell apart, the later kind is the one not observable."""

REASONS: dict[Kind, str] = {
    "alignment": "too few batches in which this tracker and another both have identified stars",
    "scale": "too few stars far enough from each other",
    "distortion": "too few stars for this degree, or only in a part of the field of view",
    "temperature": "the temperature is not known, or changes too little",
    "time_tag": "the body rates change too little: it looks like a misalignment; batches with "
    "different rates would tell them apart",
}
ABSOLUTE = (
    "the stars give the attitude through the trackers, so only angles between trackers show; "
    "{first} is taken to be where the mission has it"
)
ONE_CLOCK = "it looks like a turn of the body; {first} is taken to have the right time"


@dataclass(frozen=True)
class NotObservable:
    """Something that these stars cannot show, and the reason."""

    name: str
    reason: str


def observable(normal: Normal, unknowns: Sequence[Unknown]) -> Marks:
    """Which unknowns (p,) the normal equations determine.

    An unknown is dropped where the attitudes and the unknowns before it in `ORDER` leave
    nothing of its information, and then where its sigma is beyond what is plausible.
    """
    order = sorted(
        range(len(unknowns)),
        key=lambda at: (ORDER.index(unknowns[at].kind), unknowns[at].degree, at),
    )
    kept: list[int] = []
    for at in order:
        if _share_left(normal, kept, at) > LEAST_SHARE:
            kept.append(at)
    per_unit = np.array([each.per_unit for each in unknowns])
    while kept:
        sigma = np.sqrt(np.diag(inverse(normal.matrix[np.ix_(kept, kept)]))) / per_unit[kept]
        beyond = [
            place
            for place, at in enumerate(kept)
            if not sigma[place] <= largest_sigma(unknowns[at])
        ]
        if not beyond:
            break
        del kept[beyond[-1]]
    marks = np.zeros(len(unknowns), dtype=np.bool_)
    marks[kept] = True
    return marks


def _share_left(normal: Normal, kept: Sequence[int], at: int) -> float:
    full = normal.full[at]
    if not full > 0.0:
        return 0.0
    left = normal.matrix[at, at]
    if kept:
        across = normal.matrix[kept, at]
        scale = 1.0 / np.sqrt(np.diag(normal.matrix)[kept])
        inner = normal.matrix[np.ix_(kept, kept)] * np.outer(scale, scale)
        left -= (across * scale) @ np.linalg.solve(inner, across * scale)
    return float(left / full)


def inverse(matrix: Matrix) -> Matrix:
    """The inverse of a positive definite matrix whose rows have different units."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale))


def not_observable(
    trackers: Sequence[Tracker],
    unknowns: Sequence[Unknown],
    marks: Marks,
    attitudes_known: bool,
    time_tag: bool,
) -> tuple[NotObservable, ...]:
    """The unknowns that were dropped, and what no star shows, by name."""
    found = [
        NotObservable(each.name, REASONS[each.kind])
        for each, kept in zip(unknowns, marks, strict=True)
        if not kept
    ]
    if attitudes_known:
        return tuple(found)
    first = trackers[0].name
    always = [NotObservable("absolute alignment", ABSOLUTE.format(first=first))]
    if time_tag:
        always.append(NotObservable(f"{first} time tag", ONE_CLOCK.format(first=first)))
    return (*always, *found)
