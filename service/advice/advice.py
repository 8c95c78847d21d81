"""Advice for a mission's settings, from batches that were recorded: put together in one place.

The batches run again twice over: by verified identification, for evidence;
then with other settings, for what these would have come to.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from service.acquire import Acquisition
from service.advice.evidence import evidence_of, gathered
from service.advice.tolerances import ToleranceFinding, tolerance_findings
from service.advice.trackers import (
    AlignmentFinding,
    MagnitudeFinding,
    NoiseFinding,
    alignment_findings,
    magnitude_findings,
    noise_findings,
)
from service.advice.tried import Counts, Tried, Variant, counts_of, summed, variants
from service.errors import BadInput
from service.identify.identification import Identification
from service.missions.mission import Mission
from service.observe.batch import ObservationBatch

EVIDENCE_SHARE = 0.4
"""Of the time there is, the share in which evidence is gathered; the rest is for trying."""

Run = Callable[[ObservationBatch], Acquisition]


@dataclass(frozen=True)
class Pace:
    """How long it may take, and who is told of each step.

    `in_time` says whether a share of the time is still left; `step` is called
    after each batch of either round.
    """

    in_time: Callable[[float], bool] = lambda share: True
    step: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class Advice:
    """Everything that a sample of batches says of a mission's settings.

    `refused` counts batches that no longer fit the mission, the first reason
    beside it; `sampled` those that gave evidence.  `with_rival` counts batches in
    which two groups of stars have each an attitude, `mirrored` those that fit
    better in a mirror.  `by_votes` says whether any
    of these is identified by votes, which alone ask for the tolerances.
    """

    mission: Mission
    sampled: int
    identified: int
    refused: int
    refusal: str | None
    tolerances: tuple[ToleranceFinding, ...]
    noise: tuple[NoiseFinding, ...]
    magnitudes: tuple[MagnitudeFinding, ...]
    alignment: tuple[AlignmentFinding, ...]
    tried: tuple[Tried, ...]
    by_votes: bool
    with_rival: int
    mirrored: int


def advise(
    mission: Mission,
    batches: Sequence[ObservationBatch],
    run: Run,
    own: Mapping[str, float] | None = None,
    pace: Pace | None = None,
) -> Advice:
    """The advice that batches of a mission give; `run` takes one down the staircase.

    Batches should come in random order: where time runs out, those that are
    left are not looked at.  `own` are tolerances to be tried as well.
    """
    pace = pace or Pace()
    seen = _Seen()
    verified = Variant("", "verified")
    evidence = []
    for number, batch in enumerate(batches):
        if not pace.in_time(EVIDENCE_SHARE):
            break
        try:
            acquisition = run(verified.of(batch))
        except BadInput as error:
            seen.refuse(error)
        else:
            evidence.append(evidence_of(number, acquisition))
            sure = tuple(each.identification for each in acquisition.trackers)
            seen.cases.append((batch, sure, counts_of(acquisition, sure)))
            seen.with_rival += acquisition.rival is not None
            seen.mirrored += any(each.mirrored for each in sure)
        pace.step()
    gathered_evidence = gathered(evidence)
    tolerances = tuple(tolerance_findings(mission, gathered_evidence))
    return Advice(
        mission=mission,
        sampled=len(seen.cases),
        identified=gathered_evidence.batches,
        tolerances=tolerances,
        noise=tuple(noise_findings(mission, gathered_evidence)),
        magnitudes=tuple(magnitude_findings(mission, gathered_evidence)),
        alignment=tuple(alignment_findings(mission, gathered_evidence)),
        tried=tuple(_tried(mission, tolerances, seen, run, own or {}, pace)),
        refused=seen.refused,
        refusal=seen.refusal,
        by_votes=any(
            (batch.options.identifier or mission.identifier) == "starid" for batch, *_ in seen.cases
        ),
        with_rival=seen.with_rival,
        mirrored=seen.mirrored,
    )


@dataclass
class _Seen:
    """The batches that could be run, with what verified identification says of each."""

    cases: list[tuple[ObservationBatch, tuple[Identification, ...], Counts]] = field(
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


def _tried(
    mission: Mission,
    findings: Sequence[ToleranceFinding],
    seen: _Seen,
    run: Run,
    own: Mapping[str, float],
    pace: Pace,
) -> list[Tried]:
    present, by_probability, *others = variants(mission, findings, own)
    counts: dict[Variant, list[Counts]] = {each: [] for each in (present, *others)}
    for batch, sure, _ in seen.cases:
        if not pace.in_time(1.0):
            break
        try:
            of_batch = {each: counts_of(run(each.of(batch)), sure) for each in counts}
        except BadInput as error:
            seen.refuse(error)
        else:
            for each, found in of_batch.items():
                counts[each].append(found)
        pace.step()
    return [
        summed(present, counts[present], None),
        summed(by_probability, [found for *_, found in seen.cases], None),
        *(summed(each, counts[each], counts[present]) for each in others),
    ]
