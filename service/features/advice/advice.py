"""Advice for a mission's settings from recorded batches.

The batches run again twice: by verified identification, which gives evidence;
then with other settings, once for each variant.  A change is that of the share of stars
left ambiguous or unmatched, batch by batch beside the same identifier with the present
settings.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from msgspec import structs

from service.acquire import Acquisition
from service.acquire.result import is_mirrored
from service.errors import BadInput
from service.features.advice import trackers
from service.features.advice.evidence import evidence_of, merged
from service.features.advice.tolerances import ToleranceFinding, tolerance_findings
from service.identify.identification import Identification
from service.intervals import Z95, Interval
from service.missions.mission import Band, Identifier, Mission
from service.observations.batch import ObservationBatch

PRESENT = "present settings"
OUTCOMES = ("observed", "unique", "ambiguous", "unmatched")
ALL_RECOMMENDED = "all that is recommended"


@dataclass(frozen=True, eq=False)
class Variant:
    """Alternative mission settings for a trial: an identifier, and tolerances to replace."""

    name: str
    identifier: Identifier
    tolerances: Mapping[str, float] = field(default_factory=dict)

    def of(self, batch: ObservationBatch) -> ObservationBatch:
        """Copy of a batch with the identifier and the tolerances of a trial."""
        options = batch.options
        tolerances = {**options.tolerances, **self.tolerances}
        return structs.replace(
            batch,
            options=structs.replace(options, identifier=self.identifier, tolerances=tolerances),
        )


@dataclass(frozen=True)
class TrialCounts:
    """Numbers of unique, ambiguous and unmatched stars in one batch identified with trial settings.

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
    """Star counts of one trial of settings over all sampled batches, and the change they cause.

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
        """Percentage of the observed stars that are ambiguous or unmatched."""
        return 100.0 * (self.ambiguous + self.unmatched) / self.observed if self.observed else 0.0


def variants(findings: Sequence[ToleranceFinding], own: Mapping[str, float]) -> Iterator[Variant]:
    """Settings to try on the sample: both identifiers, each tolerance halved, doubled and as
    recommended.

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
    """Star counts of one acquisition, compared tracker by tracker with verified identification."""
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
    """Star counts summed over a sample, and their change against the present settings."""
    sums = {name: sum(getattr(each, name) for each in counts) for name in (*OUTCOMES, "other_star")}
    change = None if present is None else _change(counts, present)
    return VariantOutcome(variant, len(counts), **sums, change=change)


def _change(counts: Sequence[TrialCounts], present: Sequence[TrialCounts]) -> Interval | None:
    """Change of the percentage of stars not unique, with its 95 % interval; None with too few."""
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


EVIDENCE_SHARE, TRIALS_SHARE = 0.4, 0.7
"""Shares of the time limit at which collecting evidence and trying other mission settings end."""
LARGEST_ZONE_DEG = 80.0

RunAgain = Callable[[ObservationBatch], Acquisition]
RunWith = Callable[[Mission, ObservationBatch], Acquisition]
MOST_WITH_MISSION = 60
"""Greatest number of batches that are processed again with each changed mission file."""


@dataclass(frozen=True)
class WorkLimit:
    """Time limit of the computation of advice, with a callback for progress.

    `in_time` says whether a share of the time is still left; `step` is called
    after each batch of either round.
    """

    in_time: Callable[[float], bool] = lambda share: True
    step: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class Findings:
    """Everything that a sample of recorded batches shows about the settings of a mission.

    `refused` counts batches that no longer fit the mission, the first reason
    beside it; `sampled` those that gave evidence.  `with_rival` counts batches in
    which two groups of stars each have an attitude, `mirrored` those that fit
    better in a mirror.  `uses_voting` says whether any
    of these is identified by votes, which alone ask for the tolerances.
    """

    mission: Mission
    sampled: int
    identified: int
    refused: int
    refusal: str | None
    tolerances: tuple[ToleranceFinding, ...]
    noise: tuple[trackers.NoiseFinding, ...]
    magnitudes: tuple[trackers.MagnitudeFinding, ...]
    alignment: tuple[trackers.AlignmentFinding, ...]
    trials: tuple[VariantOutcome, ...]
    uses_voting: bool
    with_rival: int
    mirrored: int


def advise(
    mission: Mission,
    batches: Sequence[ObservationBatch],
    run: RunAgain,
    run_freely: RunAgain,
    own: Mapping[str, float] | None = None,
    pace: WorkLimit | None = None,
    run_with: RunWith | None = None,
) -> Findings:
    """Find better settings for a mission from its recorded batches; `run` acquires a batch within
    its zones.

    `run_freely` also searches the whole sky, as the service does: a batch whose attitude lies
    outside its zones fits there by chance alone, and as well in a mirror.

    Batches should come in random order: when time runs out, the rest are
    left out.  `own` are additional tolerances to try.  `run_with` acquires a batch with other
    settings of the mission: verified identification, which uses no tolerances, is tried with them.
    """
    pace = pace or WorkLimit()
    sample = _SampledBatches()
    verified = Variant("", "verified")
    parts = []
    for number, batch in enumerate(batches):
        if not pace.in_time(EVIDENCE_SHARE):
            break
        try:
            acquisition = run(verified.of(batch))
        except BadInput as error:
            sample.refuse(error)
        else:
            parts.append(evidence_of(number, acquisition))
            sure = tuple(each.identification for each in acquisition.trackers)
            sample.cases.append((batch, sure, trial_counts(acquisition, sure)))
            sample.with_rival += acquisition.rival is not None
            if any(map(is_mirrored, sure)):
                freely = run_freely(verified.of(batch)).trackers
                sample.mirrored += any(is_mirrored(each.identification) for each in freely)
        pace.step()
    evidence = merged(parts)
    uses_voting = any(
        (batch.options.identifier or mission.identifier) == "starid" for batch, *_ in sample.cases
    )
    of_mission: list[VariantOutcome] = []
    if mission.identifier == "verified" and run_with is not None:
        of_mission = list(_mission_trials(mission, sample, run_with, pace))
    tolerances = tuple(tolerance_findings(mission, evidence))
    return Findings(
        mission=mission,
        sampled=len(sample.cases),
        identified=evidence.batches,
        tolerances=tolerances,
        noise=tuple(trackers.noise_findings(mission, evidence)),
        magnitudes=tuple(trackers.magnitude_findings(mission, evidence)),
        alignment=tuple(trackers.alignment_findings(mission, evidence)),
        trials=(
            *_trials(tolerances if uses_voting else (), sample, run, own or {}, pace),
            *of_mission,
        ),
        refused=sample.refused,
        refusal=sample.refusal,
        uses_voting=uses_voting,
        with_rival=sample.with_rival,
        mirrored=sample.mirrored,
    )


@dataclass
class _SampledBatches:
    """Sampled batches with their verified identification; counts of refused and mirrored ones."""

    cases: list[tuple[ObservationBatch, tuple[Identification, ...], TrialCounts]] = field(
        default_factory=list
    )
    refused: int = 0
    refusal: str | None = None
    with_rival: int = 0
    mirrored: int = 0

    def refuse(self, error: BadInput) -> None:
        """Count a batch that the mission's present settings refuse, and keep the first reason."""
        self.refused += 1
        self.refusal = self.refusal or str(error.faults[0])


def _trials(
    findings: Sequence[ToleranceFinding],
    sample: _SampledBatches,
    run: RunAgain,
    own: Mapping[str, float],
    pace: WorkLimit,
) -> list[VariantOutcome]:
    present, by_probability, *others = variants(findings, own)
    at_present: list[TrialCounts] = []
    # Star counts with a variant and, of the same batches, with the present settings.
    counts: dict[Variant, tuple[list[TrialCounts], list[TrialCounts]]] = {
        each: ([], []) for each in others
    }
    for batch, sure, _ in sample.cases:
        if not pace.in_time(1.0):
            break
        try:
            now = trial_counts(run(present.of(batch)), sure)
        except BadInput as error:
            sample.refuse(error)
        else:
            at_present.append(now)
            for each, (tried, before) in counts.items():
                # A batch that one variant refuses is left out of that one alone.
                with suppress(BadInput):
                    tried.append(trial_counts(run(each.of(batch)), sure))
                    before.append(now)
        pace.step()
    return [
        variant_outcome(present, at_present, None),
        variant_outcome(by_probability, [found for *_, found in sample.cases], None),
        *(variant_outcome(each, tried, before) for each, (tried, before) in counts.items()),
    ]


def mission_variants(mission: Mission) -> Iterator[tuple[str, Mission]]:
    """Copies of a mission, each named and with one changed setting: sigma, zone size and others."""
    settings = mission.model_dump()
    for factor in (0.5, 2.0, 5.0):
        trackers = [
            each | {"sigma_arcsec": factor * each["sigma_arcsec"]} for each in settings["trackers"]
        ]
        yield (
            f"sigma_arcsec times {factor:g}",
            Mission.model_validate(settings | {"trackers": trackers}),
        )
    name = "half_width_deg" if isinstance(mission.zone, Band) else "radius_deg"
    for factor in (0.75, 1.5):
        value = min(factor * settings["zone"][name], LARGEST_ZONE_DEG)
        zone = settings["zone"] | {name: value}
        yield f"zone.{name} = {value:.3g}", Mission.model_validate(settings | {"zone": zone})


def _mission_trials(
    mission: Mission, sample: "_SampledBatches", run_with: RunWith, pace: WorkLimit
) -> Iterator[VariantOutcome]:
    """Star counts of sampled batches with changed missions, one changed setting at a time."""
    cases = [
        case
        for case in sample.cases[:MOST_WITH_MISSION]
        if (case[0].options.identifier or mission.identifier) == "verified"
    ]
    for name, other in mission_variants(mission):
        variant = Variant(name, "verified")
        counts, present = [], []
        for batch, sure, found in cases:
            if not pace.in_time(TRIALS_SHARE):
                break
            try:
                counts.append(trial_counts(run_with(other, variant.of(batch)), sure))
            except BadInput:
                continue
            present.append(found)
        if counts:
            yield variant_outcome(variant, counts, present)
