"""Comparison of two sets of options over the same recorded batches; nothing is stored.

Both sides compute the batches as sent, so that they differ only in their options, and not in the
time of recording.  A star's outcome is compared with the same star's on the other side.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import fmean, median
from typing import Any

import numpy as np

from service.acquire import Acquisition
from service.contract import runs as records
from service.contract.answers import StarCounts
from service.observations.batch import ObservationBatch
from service.storage.queries.compare_runs import cell_width_s
from service.storage.recording.answer import StarRow, star_rows
from service.times import HOUR_S, unix_seconds, utc_of_unix
from service.trends.measures import rms_arcsec
from service.trends.quantities import QUANTITIES
from service.vectors import attitude_error_arcsec, matrix_from_quaternion

MAX_SHOWN = 100
"""Largest number of batches shown star by star; further ones are only counted."""
MOST_AT_ONCE, PORTION_S = 512, 0.1
"""Largest number of batches solved at once, and the target seconds for both sides."""

RunManyAgain = Callable[[Sequence[ObservationBatch]], Sequence[Acquisition]]


_OUTCOMES = ("observed", "unique", "ambiguous", "unmatched")


@dataclass(frozen=True)
class Pair:
    """Recorded batch in two versions, with the options of sides a and b in place of its own."""

    id: str
    a: ObservationBatch
    b: ObservationBatch


@dataclass
class _Side:
    """One side of a comparison: results of all batches with one set of options."""

    counts: "Counter[str]" = field(default_factory=Counter)
    ratios: list[float] = field(default_factory=list)
    work_us: list[int] = field(default_factory=list)

    def add(self, acquisition: Acquisition) -> None:
        solution = acquisition.solution
        self.counts.update(acquisition.counts)
        self.counts["solved"] += solution is not None
        self.counts["suspect"] += solution is not None and solution.suspect
        residual, predicted = rms_arcsec(acquisition)
        rms = {"residual_rms_arcsec": residual, "predicted_rms_arcsec": predicted}
        ratio = QUANTITIES["residual_ratio"].value_of(rms)
        if ratio is not None:
            self.ratios.append(ratio)
        self.work_us.append(sum(acquisition.timings_us.values()))

    def record(self, options: dict[str, Any]) -> records.ComparedSide:
        names = (*_OUTCOMES, "solved", "suspect")
        return records.ComparedSide(
            options=options,
            **{name: int(self.counts[name]) for name in names},
            residual_ratio_mean=fmean(self.ratios) if self.ratios else None,
            us_per_batch=median(self.work_us) if self.work_us else None,
        )


@dataclass
class ComparedSample:
    """Sample of batches in a comparison: its source, the number available and the number drawn."""

    spacecraft: str
    run: str
    first: str | None
    last: str | None
    total: int
    drawn: int


@dataclass
class ComparisonTally:
    """Running totals of a comparison for both sides, star by star."""

    a: _Side = field(default_factory=_Side)
    b: _Side = field(default_factory=_Side)
    compared: int = 0
    transitions: "Counter[tuple[str, str]]" = field(default_factory=Counter)
    renamed: int = 0
    attitudes: "Counter[str]" = field(default_factory=Counter)
    angles_arcsec: list[float] = field(default_factory=list)
    changed: list[records.BatchChange] = field(default_factory=list)
    changed_batches: int = 0
    counted: list[tuple[int, dict[str, int], dict[str, int]]] = field(default_factory=list)
    """Time (TAI, ns) of each batch, and its number of stars by outcome on both sides."""

    def add(self, pair: Pair, a: Acquisition, b: Acquisition) -> None:
        """Add the two results of one batch to the comparison."""
        self.compared += 1
        self.a.add(a)
        self.b.add(b)
        self.counted.append((pair.a.time.tai_ns, a.counts, b.counts))
        angle_arcsec = _angle_arcsec(a, b)
        has = a.solution is not None, b.solution is not None
        self.attitudes[_WHICH[has]] += 1
        if angle_arcsec is not None:
            self.angles_arcsec.append(angle_arcsec)
        stars = [(one, other) for one, other in zip(star_rows(a), star_rows(b), strict=True)]
        self.transitions.update((one.outcome, other.outcome) for one, other in stars)
        differing = [each for each in stars if _named(each[0]) != _named(each[1])]
        self.renamed += sum(one.outcome == other.outcome == "unique" for one, other in differing)
        if differing or has[0] != has[1]:
            self.changed_batches += 1
            if len(self.changed) < MAX_SHOWN:
                self.changed.append(_changed(pair, a, b, differing, angle_arcsec))

    def record(
        self,
        sample: ComparedSample,
        options: tuple[dict[str, Any], dict[str, Any]],
        *,
        cut_short: bool,
    ) -> records.Comparison:
        """Build the record of the whole comparison; `options` are those of both sides."""
        angles = self.angles_arcsec
        cell_s, trend = self._trend()
        return records.Comparison(
            spacecraft=sample.spacecraft,
            run=sample.run,
            start=sample.first,
            end=sample.last,
            batches_in_stretch=sample.total,
            sampled=sample.drawn,
            cut_short=cut_short,
            compared=self.compared,
            cell_s=cell_s,
            trend=trend,
            a=self.a.record(options[0]),
            b=self.b.record(options[1]),
            transitions=[
                records.Transition(from_=one, to=other, stars=stars)
                for (one, other), stars in sorted(self.transitions.items())
            ],
            renamed=self.renamed,
            attitudes=records.ComparedAttitudes(
                **{name: self.attitudes[name] for name in _WHICH.values()},
                angle_arcsec_median=median(angles) if angles else None,
                angle_arcsec_max=max(angles) if angles else None,
            ),
            changed_batches=self.changed_batches,
            changed=sorted(self.changed, key=lambda each: each.time),
        )

    def _trend(self) -> tuple[int, list[records.ComparedCell]]:
        """Width of the time cells in seconds, and stars by outcome in each non-empty cell."""
        moments_s = unix_seconds([tai_ns for tai_ns, _, _ in self.counted])
        cell_s = cell_width_s(float(np.ptp(moments_s))) if self.counted else HOUR_S
        cells: dict[int, tuple[Counter[str], Counter[str]]] = {}
        for number, (_, a, b) in zip((moments_s // cell_s).tolist(), self.counted, strict=True):
            sides = cells.setdefault(int(number), (Counter(), Counter()))
            for side, counts in zip(sides, (a, b), strict=True):
                side.update(counts)
        return cell_s, [
            records.ComparedCell(
                start=utc_of_unix(number * cell_s).text,
                **{
                    name: StarCounts(**{each: side[each] for each in _OUTCOMES})
                    for name, side in zip("ab", cells[number], strict=True)
                },
            )
            for number in sorted(cells)
        ]


_WHICH = {
    (True, True): "both",
    (True, False): "only_a",
    (False, True): "only_b",
    (False, False): "neither",
}


def compare(
    pairs: Sequence[Pair], run_again: tuple[RunManyAgain, RunManyAgain], limit_s: float
) -> tuple[ComparisonTally, bool]:
    """Run a sample of batches with both sets of options; also tells if the time ran out.

    `limit_s` bounds the time in seconds.  Many batches are solved at once, but singly while each
    may take seconds.
    """
    found, end_s = ComparisonTally(), time.monotonic() + limit_s
    first, count = 0, 1
    while first < len(pairs):
        started_s = time.monotonic()
        if started_s > end_s:
            return found, True
        # Sorted by time, a day's sky is computed only once.
        portion = sorted(pairs[first : first + count], key=lambda each: each.a.time.tai_ns)
        sides = run_again[0]([each.a for each in portion]), run_again[1]([e.b for e in portion])
        for each in zip(portion, *sides, strict=True):
            found.add(*each)
        first += count
        pace = PORTION_S / max(time.monotonic() - started_s, 1e-6)
        count = max(1, min(MOST_AT_ONCE, int(count * pace)))
    return found, False


def _changed(
    pair: Pair,
    a: Acquisition,
    b: Acquisition,
    differing: Sequence[tuple[StarRow, StarRow]],
    angle_arcsec: float | None,
) -> records.BatchChange:
    return records.BatchChange(
        id=pair.id,
        batch=pair.a.batch,
        time=pair.a.time.text,
        a=StarCounts(**a.counts),
        b=StarCounts(**b.counts),
        attitude_angle_arcsec=angle_arcsec,
        stars=[
            records.StarChange(
                tracker=one.tracker, position=one.position, a=_star(one), b=_star(other)
            )
            for one, other in differing
        ],
    )


def _star(star: StarRow) -> records.StarSide:
    return records.StarSide(outcome=star.outcome, star=star.star_id)


def _named(star: StarRow) -> tuple[str, str | None]:
    return star.outcome, star.star_id


def _angle_arcsec(a: Acquisition, b: Acquisition) -> float | None:
    if a.solution is None or b.solution is None:
        return None
    one, other = (matrix_from_quaternion(each.quaternion) for each in (a.solution, b.solution))
    return math.hypot(*attitude_error_arcsec(one, other).tolist())
