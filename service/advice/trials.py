"""The outcomes of a sample's stars with other settings.

Every batch of the sample is acquired again, once for each
variant.  A change is that of the share of stars left ambiguous or unmatched,
batch by batch beside the same identifier with the present settings.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from msgspec import structs

from service.acquire import Acquisition
from service.advice.intervals import Z95, Interval
from service.advice.tolerances import ToleranceFinding
from service.identify.identification import Identification
from service.missions.mission import Identifier
from service.observations.batch import ObservationBatch

PRESENT = "present settings"
OUTCOMES = ("observed", "unique", "ambiguous", "unmatched")
ALL_RECOMMENDED = "all that is recommended"


@dataclass(frozen=True, eq=False)
class Variant:
    """Other settings: an identifier, and tolerances in place of the mission's."""

    name: str
    identifier: Identifier
    tolerances: Mapping[str, float] = field(default_factory=dict)

    def of(self, batch: ObservationBatch) -> ObservationBatch:
        """The batch with these settings in place of its own."""
        options = batch.options
        tolerances = {**options.tolerances, **self.tolerances}
        return structs.replace(
            batch,
            options=structs.replace(options, identifier=self.identifier, tolerances=tolerances),
        )


@dataclass(frozen=True)
class TrialCounts:
    """Outcomes of the stars of one batch under a variant.

    `other_star` counts the stars that are unique here and under verified
    identification, but not the same star.
    """

    observed: int
    unique: int
    ambiguous: int
    unmatched: int
    other_star: int = 0


@dataclass(frozen=True)
class VariantOutcome:
    """A variant with the sums over the sample, and the change from the present settings.

    `change` is that of the share of stars not unique, in percentage points;
    None for the present settings themselves.
    """

    variant: Variant
    batches: int
    observed: int
    unique: int
    ambiguous: int
    unmatched: int
    other_star: int
    change: Interval | None

    @property
    def not_unique_percent(self) -> float:
        """Stars ambiguous or unmatched, in percent of the observed."""
        return 100.0 * (self.ambiguous + self.unmatched) / self.observed if self.observed else 0.0


def variants(findings: Sequence[ToleranceFinding], own: Mapping[str, float]) -> Iterator[Variant]:
    """The variants to try: both identifiers, each tolerance halved, doubled and as recommended.

    `own` are requested values, tried together.  The tolerances belong
    to the votes: verified identification is tried once, with the present tolerances.
    """
    yield Variant(PRESENT, "starid")
    yield Variant(PRESENT, "verified")
    for finding in findings:
        name = finding.tolerance.name
        if finding.verdict == "not_used":
            continue
        for factor in (0.5, 2.0):
            value = min(finding.now * factor, finding.tolerance.most)
            if value != finding.now:
                yield Variant(f"{name} = {value:.4g}", "starid", {name: value})
        if finding.recommended is not None:
            value = finding.recommended
            yield Variant(f"{name} = {value:.4g}, recommended", "starid", {name: value})
    recommended = {
        each.tolerance.name: each.recommended for each in findings if each.recommended is not None
    }
    if len(recommended) > 1:
        yield Variant(ALL_RECOMMENDED, "starid", recommended)
    if own:
        shown = ", ".join(f"{name} = {value:g}" for name, value in own.items())
        yield Variant(f"{shown}, asked for", "starid", own)


def trial_counts(acquisition: Acquisition, verified: Sequence[Identification]) -> TrialCounts:
    """The outcomes of one batch, held against those of verified identification by tracker."""
    other_star = 0
    for each, sure in zip(acquisition.trackers, verified, strict=True):
        mine = each.identification
        both = mine.unique & sure.unique
        other_star += int(np.count_nonzero(both & (mine.star != sure.star)))
    counts = acquisition.counts
    return TrialCounts(**{name: counts[name] for name in OUTCOMES}, other_star=other_star)


def variant_outcome(
    variant: Variant, counts: Sequence[TrialCounts], present: Sequence[TrialCounts] | None
) -> VariantOutcome:
    """The sums over a sample, and the change from the same batches under the present settings."""
    sums = {name: sum(getattr(each, name) for each in counts) for name in (*OUTCOMES, "other_star")}
    change = None if present is None else _change(counts, present)
    return VariantOutcome(variant, len(counts), **sums, change=change)


def _change(counts: Sequence[TrialCounts], present: Sequence[TrialCounts]) -> Interval | None:
    """The ratio of sums over batches, with the linearised variance of a ratio."""
    stars = np.array([each.observed for each in counts], float)
    lost = np.array(
        [before.unique - after.unique for after, before in zip(counts, present, strict=True)],
        float,
    )
    n, total = len(stars), float(stars.sum())
    if n < 2 or total == 0.0:
        return None
    change = float(lost.sum()) / total
    spread = lost - change * stars
    half = Z95 * math.sqrt(float(spread @ spread) * n / (n - 1)) / total
    return Interval(100.0 * change, 100.0 * (change - half), 100.0 * (change + half))
