"""Advice for a mission's settings from recorded batches.

The batches run again twice: by verified identification, which gives evidence;
then with other settings, to compare their outcomes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from service.acquire import Acquisition
from service.advice import trackers
from service.advice.evidence import evidence_of, merged
from service.advice.tolerances import ToleranceFinding, tolerance_findings
from service.advice.trials import (
    TrialCounts,
    Variant,
    VariantOutcome,
    trial_counts,
    variant_outcome,
    variants,
)
from service.errors import BadInput
from service.identify.identification import Identification
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch

EVIDENCE_SHARE = 0.4
"""The share of the time in which evidence is collected; the rest is for trials."""

RunAgain = Callable[[ObservationBatch], Acquisition]


@dataclass(frozen=True)
class WorkLimit:
    """How long the work may take, and a callback for its progress.

    `in_time` says whether a share of the time is still left; `step` is called
    after each batch of either round.
    """

    in_time: Callable[[float], bool] = lambda share: True
    step: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class Findings:
    """The findings of a sample of batches on a mission's settings.

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
) -> Findings:
    """The advice that batches of a mission give; `run` acquires one batch within its zones.

    `run_freely` also searches the whole sky, as the service does: a batch whose attitude lies
    outside its zones fits there by chance alone, and as well in a mirror.

    Batches should come in random order: when time runs out, the rest are
    left out.  `own` are additional tolerances to try.
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
            if any(each.mirrored for each in sure):
                freely = run_freely(verified.of(batch)).trackers
                sample.mirrored += any(each.identification.mirrored for each in freely)
        pace.step()
    evidence = merged(parts)
    tolerances = tuple(tolerance_findings(mission, evidence))
    return Findings(
        mission=mission,
        sampled=len(sample.cases),
        identified=evidence.batches,
        tolerances=tolerances,
        noise=tuple(trackers.noise_findings(mission, evidence)),
        magnitudes=tuple(trackers.magnitude_findings(mission, evidence)),
        alignment=tuple(trackers.alignment_findings(mission, evidence)),
        trials=tuple(_trials(tolerances, sample, run, own or {}, pace)),
        refused=sample.refused,
        refusal=sample.refusal,
        uses_voting=any(
            (batch.options.identifier or mission.identifier) == "starid"
            for batch, *_ in sample.cases
        ),
        with_rival=sample.with_rival,
        mirrored=sample.mirrored,
    )


@dataclass
class _SampledBatches:
    """The batches that could run, each with its verified identification."""

    cases: list[tuple[ObservationBatch, tuple[Identification, ...], TrialCounts]] = field(
        default_factory=list
    )
    refused: int = 0
    refusal: str | None = None
    with_rival: int = 0
    mirrored: int = 0

    def refuse(self, error: BadInput) -> None:
        """Note a batch that does not fit the mission any more, or asks for too much work."""
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
    counts: dict[Variant, list[TrialCounts]] = {each: [] for each in (present, *others)}
    for batch, sure, _ in sample.cases:
        if not pace.in_time(1.0):
            break
        try:
            of_batch = {each: trial_counts(run(each.of(batch)), sure) for each in counts}
        except BadInput as error:
            sample.refuse(error)
        else:
            for each, found in of_batch.items():
                counts[each].append(found)
        pace.step()
    return [
        variant_outcome(present, counts[present], None),
        variant_outcome(by_probability, [found for *_, found in sample.cases], None),
        *(variant_outcome(each, counts[each], counts[present]) for each in others),
    ]
