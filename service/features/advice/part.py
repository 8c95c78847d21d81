"""Service that computes advice on a mission's settings from recorded batches."""

import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from service.acquire import Acquisition
from service.acquire.choices import idle_reason
from service.app.context import Context
from service.app.factory import App
from service.errors import BadInput, Busy, Fault
from service.features.advice import records
from service.features.advice.advice import Findings, VariantOutcome, WorkLimit, advise
from service.features.advice.causes import Part, StarTable, causes, common_rivals, parts, star_table
from service.features.advice.innovations import (
    InnovationFinding,
    innovation_findings,
    innovation_noise,
)
from service.features.advice.prior_errors import latest_prior_errors
from service.features.advice.statements import (
    Statement,
    alignment_statement,
    group_statements,
    magnitude_statement,
    noise_statement,
    tolerance_statement,
    zone_statements,
)
from service.features.advice.tolerances import ToleranceFinding
from service.features.advice.trackers import (
    AlignmentFinding,
    MagnitudeFinding,
    NoiseFinding,
    NoisePeriod,
)
from service.features.advice.zone_size import ZoneCost, ZoneSize, zone_cost, zone_size
from service.ingest.submit import SubmissionService
from service.intervals import Interval
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.schema import LIVE, TolerancesIn
from service.sky.catalog.run_catalog import RunCatalog
from service.storage.queries.definitive import latest_innovations
from service.storage.queries.pages import ResultFilter, latest_time
from service.storage.queries.period import sample_period
from service.storage.queries.results import BatchSample, sample_batches
from service.storage.queries.time_buckets import BucketFilter, read_buckets, totals
from service.storage.sql.tables import COUNTS
from service.times import DAY_S, Utc, recorded_utc, shifted, utc_now

ADVICE_SAMPLE = 200
"""Default number of batches for advice: sigma accurate to about 5 %, processed in seconds."""
NO_TOLERANCES = TolerancesIn()
CAUSES_SAMPLE = 300
"""Number of recorded batches per period read to find causes; takes less than half a second."""


@dataclass(frozen=True)
class Ambiguity:
    """Ambiguous stars of a period compared with an earlier one, with causes and rival stars.

    The first part and the counts are those of the whole periods; the rest is from a sample.
    """

    parts: list[Part]
    causes: list[records.Cause]
    rivals: list[tuple[str, int]]
    batches: int
    total: int
    ambiguous: int
    """Number of ambiguous stars in the sample."""
    counts: Mapping[str, int]
    counts_before: Mapping[str, int] | None


MOST_ERRORS = 10_000
MOST_COSTS = 1_000


class ZoneSizes:
    """Advises on the sizes of zones from recorded a priori errors, and caches their costs."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._costs: dict[tuple[str, str, float], ZoneCost] = {}

    def advised(self, name: str, run: str | None) -> tuple[ZoneSize, list[ZoneCost]]:
        """Advice on the size of a spacecraft's zone by a run's a priori errors.

        The errors are those of the latest `MOST_ERRORS` batches; a batch without an attitude
        has none.  The costs are those of the sizes, where another size is advised.
        """
        size, cost_of = self._size(name, run)
        changes = size.verdict in ("too_small", "larger_than_needed")
        return size, [cost_of(each) for each in size.sizes_deg] if changes else []

    def _size(self, name: str, run: str | None) -> tuple[ZoneSize, Callable[[float], ZoneCost]]:
        mission = self._context.mission(name)
        place = ResultFilter(run or LIVE, name)
        with self._context.reading_record() as connection:
            time = latest_time(connection, place, utc_now())
            angles_deg, sigmas_deg = latest_prior_errors(connection, place, MOST_ERRORS)
        run_catalog = self._context.sky.run_catalog(mission, time or utc_now())
        size = zone_size(mission, angles_deg, sigmas_deg)
        return size, partial(self._cost, mission, run_catalog)

    def _cost(self, mission: Mission, run_catalog: RunCatalog, size_deg: float) -> ZoneCost:
        """Counts of stars and pairs in zones of a size, cached; counting takes up to seconds."""
        key = mission.digest, run_catalog.digest, size_deg
        if key not in self._costs:
            if len(self._costs) >= MOST_COSTS:
                self._costs.clear()
            self._costs[key] = zone_cost(mission, run_catalog.direction, size_deg)
        return self._costs[key]


class AdviceService:
    """Computes advice on mission settings, for one caller at a time."""

    def __init__(self, context: Context, submissions: SubmissionService) -> None:
        self._context = context
        self._zone_sizes = ZoneSizes(context)
        self._submissions = submissions
        self._lock = threading.Lock()

    def close(self) -> None:
        """Do nothing on closing: no file and no thread is open."""

    def ambiguity(
        self, name: str, run: str, start: Utc, end: Utc, earlier_s: float = DAY_S
    ) -> Ambiguity:
        """Explain ambiguous stars of a period, compared with the period `earlier_s` before."""
        now = self._stars(name, run, start, end)
        before = self._stars(name, run, shifted(start, -earlier_s), shifted(end, -earlier_s))
        earlier = before if before.batches else None
        with self._context.reading() as connection:
            counts, counts_before = (
                totals(read_buckets(connection, BucketFilter(name, run, *each), "hour", COUNTS))
                for each in (
                    (start, end),
                    (shifted(start, -earlier_s), shifted(end, -earlier_s)),
                )
            )
        found = parts(now, earlier)
        if found and counts["observed"]:
            share, before_share = (
                each["ambiguous"] / max(each["observed"], 1) for each in (counts, counts_before)
            )
            found[0] = found[0].with_shares(counts["observed"], share, before_share)
        return Ambiguity(
            parts=found,
            causes=causes(now, earlier),
            rivals=common_rivals(now),
            batches=now.batches,
            total=now.total,
            ambiguous=int(now.ambiguous.sum()),
            counts=counts,
            counts_before=None if earlier is None else counts_before,
        )

    def _run_with(self, mission: Mission, batch: ObservationBatch) -> Acquisition:
        return self._submissions.run_again(batch, mission.within_zones)

    def _stars(self, name: str, run: str, start: Utc, end: Utc) -> StarTable:
        with self._context.reading() as connection:
            sample = sample_period(connection, BucketFilter(name, run, start, end), CAUSES_SAMPLE)
        return star_table(sample, self._context.sky)

    def of_spacecraft(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        sample: int = ADVICE_SAMPLE,
        tolerances: TolerancesIn = NO_TOLERANCES,
        limit_s: float = math.inf,
        step: Callable[[], object] = lambda: None,
    ) -> records.Advice:
        """Advice on a mission's settings from the batches of a run; see `advise`.

        At most `sample` batches are processed again, fewer if `limit_s` seconds run out; `step` is
        called after each batch, twice per batch.  `tolerances` are tried as well.  Raises `Busy`
        while the service is computing other advice.
        """
        mission = self._context.mission(name)
        own = tolerances.model_dump(exclude_none=True)
        for key in own:
            reason = idle_reason(key, "starid", mission.tests, mission.zone)
            if reason is not None:
                raise BadInput(Fault(f"tolerance {key}", f"{reason} and would change nothing"))
        if not self._lock.acquire(blocking=False):
            raise Busy("the service is computing other advice", 10)
        try:
            with self._context.reading() as connection:
                selected = ResultFilter(run or LIVE, name, start, end)
                archive = self._context.store.archive
                drawn = sample_batches(connection, archive, selected, sample)
                met = latest_innovations(connection, selected, of_gyro=True)
            began = time.monotonic()
            pace = WorkLimit(lambda share: time.monotonic() - began < share * limit_s, step)
            # No search of the whole sky, which would hide faults of the settings.
            run_again = partial(self._submissions.run_again, mission=mission.within_zones)
            run_freely = partial(self._submissions.run_again, mission=mission)
            findings = advise(
                mission, drawn.batches, run_again, run_freely, own, pace, self._run_with
            )
            zone = zone_statements(mission, *self._zone_sizes.advised(name, run))
        finally:
            self._lock.release()
        noise = innovation_findings(innovation_noise(met), mission, findings.noise)
        found: list[records.Cause] = []
        if drawn.first and drawn.last:
            last = shifted(recorded_utc(drawn.last), 1.0)
            first = max(
                start or recorded_utc(drawn.first), shifted(last, -DAY_S), key=lambda t: t.tai_ns
            )
            found = self.ambiguity(name, run or LIVE, first, end or last).causes
        return advice_record(name, run or LIVE, drawn, findings, zone, noise, found)


def advice_record(
    spacecraft: str,
    run: str,
    sample: BatchSample,
    findings: Findings,
    zone: Sequence[Statement],
    innovations: Sequence[InnovationFinding] = (),
    causes: Sequence[records.Cause] = (),
) -> records.Advice:
    """Combine findings, trials and sentences to the advice record of the API."""
    tolerances = [(each, tolerance_statement(each, findings)) for each in findings.tolerances]
    noise = [(each, noise_statement(each)) for each in findings.noise]
    magnitudes = [(each, magnitude_statement(each, findings)) for each in findings.magnitudes]
    alignment = [(each, alignment_statement(each)) for each in findings.alignment]
    statements = [*zone]
    statements += [
        each for pairs in (tolerances, noise, magnitudes, alignment) for _, each in pairs
    ]
    statements += [each.statement for each in innovations]
    return records.Advice(
        spacecraft=spacecraft,
        run=run,
        first=sample.first,
        last=sample.last,
        batches_in_range=sample.total,
        batches_sampled=findings.sampled,
        batches_identified=findings.identified,
        batches_refused=findings.refused,
        refusal=findings.refusal,
        mission=findings.mission.digest,
        identifier=findings.mission.identifier,
        causes=list(causes),
        groups=[
            records.GroupAdvice(action=each.action, text=each.text)
            for each in group_statements(findings)
        ],
        zone=[records.ZoneAdvice(action=each.action, text=each.text) for each in zone],
        tolerances=[_tolerance(*each, findings.uses_voting) for each in tolerances],
        noise=[_noise(*each) for each in noise],
        magnitudes=[_magnitude(*each) for each in magnitudes],
        alignment=[_alignment(*each) for each in alignment],
        innovations=[_innovation(each) for each in innovations],
        tried=[_trial(each) for each in findings.trials],
        changes=_changes(statements),
    )


def _tolerance(
    finding: ToleranceFinding, statement: Statement, is_used: bool
) -> records.ToleranceAdvice:
    return records.ToleranceAdvice(
        tolerance=finding.tolerance.name,
        symbol=finding.symbol,
        unit=finding.tolerance.unit,
        now=finding.now,
        verdict=finding.verdict if is_used else "not_used",
        confidence=finding.confidence if is_used else "none",
        differences=finding.differences,
        batches=finding.batches,
        needed=_estimate(finding.needed),
        share_beyond=_estimate(finding.beyond),
        recommended=finding.recommended,
        action=statement.action,
        text=statement.text,
    )


def _noise(finding: NoiseFinding, statement: Statement) -> records.NoiseAdvice:
    return records.NoiseAdvice(
        tracker=finding.tracker,
        now_arcsec=finding.now_arcsec,
        sigma_arcsec=_estimate(finding.sigma_arcsec),
        batches=finding.batches,
        verdict=finding.verdict,
        worst=_noise_period(finding.worst),
        action=statement.action,
        text=statement.text,
    )


def _noise_period(found: NoisePeriod | None) -> records.NoisePeriodAdvice | None:
    if found is None:
        return None
    return records.NoisePeriodAdvice(
        sigma_arcsec=_bounded(found.sigma_arcsec),
        batches=found.batches,
        first=found.first.text,
        last=found.last.text,
    )


def _magnitude(finding: MagnitudeFinding, statement: Statement) -> records.MagnitudeAdvice:
    return records.MagnitudeAdvice(
        tracker=finding.tracker,
        pivot_mag=None if math.isnan(finding.pivot_mag) else finding.pivot_mag,
        offset_mag=_estimate(finding.offset_mag),
        scale=_estimate(finding.scale),
        now_sigma_mag=finding.now_sigma_mag,
        scatter_mag=_estimate(finding.scatter_mag),
        stars=finding.stars,
        verdict=finding.verdict,
        scatter_verdict=finding.scatter_verdict,
        action=statement.action,
        text=statement.text,
    )


def _alignment(finding: AlignmentFinding, statement: Statement) -> records.AlignmentAdvice:
    rotation, axes = finding.rotation_arcsec, finding.axes_body
    return records.AlignmentAdvice(
        tracker=finding.tracker,
        reference=finding.reference,
        rotation_arcsec=None if rotation is None else [_bounded(part) for part in rotation],
        axes_body=None if axes is None else [list(axis) for axis in axes],
        batches=finding.batches,
        verdict=finding.verdict,
        action=statement.action,
        text=statement.text,
    )


def _innovation(finding: InnovationFinding) -> records.InnovationAdvice:
    return records.InnovationAdvice(
        subject=finding.subject,
        ratio=_estimate(finding.ratio),
        measurements=finding.measurements,
        action=finding.statement.action,
        text=finding.statement.text,
    )


def _trial(outcome: VariantOutcome) -> records.Trial:
    return records.Trial(
        name=outcome.variant.name,
        identifier=outcome.variant.identifier,
        tolerances=dict(outcome.variant.tolerances),
        batches=outcome.batches,
        observed=outcome.observed,
        unique=outcome.unique,
        ambiguous=outcome.ambiguous,
        unmatched=outcome.unmatched,
        named_otherwise=outcome.other_star,
        change_points=_estimate(outcome.change),
    )


def _changes(statements: Iterable[Statement]) -> list[records.Change]:
    """Lines to change in the mission file, each key of a table once even if trackers share it."""
    lines: dict[tuple[str, str | None, str], records.Change] = {}
    for each in (change for statement in statements for change in statement.changes):
        key = each.table, each.tracker, each.line.partition(" = ")[0]
        lines.setdefault(
            key, records.Change(table=each.table, tracker=each.tracker, line=each.line)
        )
    return list(lines.values())


def _estimate(found: Interval | None) -> records.Estimate | None:
    return None if found is None else _bounded(found)


def _bounded(found: Interval) -> records.Estimate:
    """Convert an interval to an API record, with null for an infinite bound."""
    low, high = (part if math.isfinite(part) else None for part in (found.low, found.high))
    return records.Estimate(value=found.value, low=low, high=high)


def no_changes_text(advice: records.Advice) -> str:
    """Text shown when no line of the mission file should change."""
    findings = (
        advice.groups,
        advice.zone,
        advice.tolerances,
        advice.noise,
        advice.magnitudes,
        advice.alignment,
        advice.innovations,
    )
    actions = {each.action for found in findings for each in found}
    if actions - {"keep", "wait"}:
        return "No line of the mission file corrects these findings: each sentence says what to do."
    if "wait" in actions:
        return "The batches so far give no reason to change the mission file."
    return "The mission file needs no change."


def best_setting(advice: records.Advice) -> tuple[records.Trial, records.Trial] | None:
    """Trial with present settings and trial of the one setting that leaves the fewest ambiguous
    stars.

    Only trials of the identifier in use count.  None if no setting certainly leaves fewer, or if it
    leaves more stars unmatched.
    """
    own = [each for each in advice.tried if each.identifier == advice.identifier and each.observed]
    present = next((each for each in own if each.change_points is None), None)
    if present is None:
        return None
    better = [
        each
        for each in own
        if each.change_points is not None
        and each.change_points.high is not None
        and each.change_points.high < 0.0
        and len(each.tolerances) <= 1
        and each.ambiguous * present.observed < present.ambiguous * each.observed
    ]
    if not better:
        return None
    return present, min(better, key=lambda each: (each.ambiguous + each.unmatched) / each.observed)


def open_part(app: App) -> AdviceService:
    """Create the advice service for an open app."""
    return AdviceService(app.context, app.submissions)
