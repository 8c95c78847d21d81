"""Named runs: lists, evaluation of limits, comparisons, removal, and reprocessing."""

import hashlib
from collections.abc import Callable, Collection, Mapping

from sqlalchemy import Connection

from service.access import Entry
from service.app.context import Context, checked_run_name
from service.contract import runs
from service.errors import BadBatch, Fault
from service.ingest.reprocess import ReprocessPlan, ReprocessProgress, reprocess
from service.ingest.solver_pool import Solver
from service.missions.mission import Mission, mission_named
from service.observations.schema import LIVE
from service.storage.queries import fleet, histories
from service.storage.queries.compare_runs import changed_batches, compare_runs, run_rates
from service.storage.queries.pages import ResultFilter
from service.storage.recording.results import set_run_alarms
from service.storage.upkeep.forget import ForgetFilter, forget, found
from service.times import Utc, utc_now

MOST_COMPARED = 2_000
"""Largest number of batches compared for a page, which takes less than a second."""


class Runs:
    """Service that lists, compares, reprocesses and removes runs."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def all(self, spacecraft: Collection[str] | None = None) -> list[runs.Run]:
        """List all runs with batches; with `spacecraft`, only batches of these count."""
        with self._context.reading() as connection:
            return histories.list_runs(connection, spacecraft)

    def default(self) -> str:
        """Run to show first: the live one, or the newest while that is empty."""
        with self._context.reading() as connection:
            return fleet.default_run(connection)

    def watch(self, run: str, alarms: bool = True, entry: Entry | None = None) -> runs.RunState:
        """Switch the evaluation of limits for future batches of a run on or off."""
        name = checked_run_name(run)
        if name == LIVE and not alarms:
            raise BadBatch(Fault("alarms", "alarms are always on for live batches", "False"))
        self._context.require_alarms(alarms)
        self._context.change_audited(
            lambda connection: set_run_alarms(connection, name, alarms, utc_now().text), entry
        )
        return runs.RunState(run=name, alarms=alarms)

    def forget(self, selected: ForgetFilter, entry: Entry | None = None) -> runs.Forgotten:
        """Remove a run, or some of its batches and gyro blocks; see `upkeep.forget`."""
        checked_run_name(selected.run)

        def note(connection: Connection, total: runs.Forgotten) -> None:
            if entry is not None:
                entry.add_to(connection)

        return forget(
            self._context.store, selected, self._context.settings.archive_folder, note=note
        )

    def would_forget(self, selected: ForgetFilter) -> runs.Forgotten:
        """Count the data that `forget` would remove."""
        checked_run_name(selected.run)
        with self._context.reading() as connection:
            return found(connection, selected)

    def compare(
        self,
        run: str,
        other: str,
        spacecraft: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
    ) -> runs.RunComparison:
        """Compare the outcomes of the same stars in two runs, and their attitudes."""
        with self._context.reading() as connection:
            return compare_runs(
                connection,
                self._context.store.archive,
                ResultFilter(run, spacecraft, start, end),
                other,
            )

    def compare_latest(
        self,
        run: str,
        other: str,
        spacecraft: str,
        start: Utc | None = None,
        end: Utc | None = None,
    ) -> tuple[runs.RunComparison, list[runs.RunChange]]:
        """Compare two runs over a spacecraft's latest batches of a period; list differences."""
        self._context.mission(spacecraft)
        place, archive = ResultFilter(run, spacecraft, start, end), self._context.store.archive
        with self._context.reading() as connection:
            found = compare_runs(connection, archive, place, other, MOST_COMPARED)
            changed = changed_batches(connection, archive, place, other, MOST_COMPARED, 50)
        return found, changed

    def rates(
        self,
        run: str,
        other: str,
        spacecraft: str,
        start: Utc | None = None,
        end: Utc | None = None,
    ) -> runs.RatesOfRuns | None:
        """Rates of stars by outcome of a spacecraft in both runs; None without a common period."""
        with self._context.reading() as connection:
            return run_rates(connection, spacecraft, (run, other), start, end)

    def reprocess(
        self,
        run: str | None,
        *,
        source: str = LIVE,
        spacecraft: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        processes: int = 0,
        track: bool = False,
        step: Callable[[ReprocessProgress], object] = lambda progress: None,
    ) -> ReprocessProgress:
        """Process the batches of a run again into another run, with the settings of this app.

        Without `run` the name is derived from the settings.  Batches that the run already has are
        skipped.  With `track` stars are searched about the last attitude of the run, batch after
        batch.  Raises `BadBatch` if the run has results of other settings.
        """
        plan = self.plan(run, source, spacecraft, start, end, processes, track)
        sky = self._context.sky
        own = Solver(plan.missions, sky)
        return reprocess(self._context.store, plan, sky.catalog.digest, own, step)

    def plan(
        self,
        run: str | None,
        source: str,
        spacecraft: str | None,
        start: Utc | None,
        end: Utc | None,
        processes: int,
        track: bool = False,
    ) -> ReprocessPlan:
        """Plan a reprocessing with the settings of this app; see `reprocess`."""
        if spacecraft is not None:
            mission_named(self._context.missions, spacecraft)
        chosen = {
            name: each
            for name, each in self._context.missions.items()
            if spacecraft in (None, name)
        }
        return ReprocessPlan(
            stretch=ResultFilter(source, spacecraft, start, end),
            run=checked_run_name(run or self._run_of_settings(source, chosen, track)),
            missions=chosen,
            catalog=self._context.settings.catalog,
            cache_bytes=self._context.settings.shelf_mb << 20,
            processes=processes,
            track=track,
        )

    def _run_of_settings(self, source: str, missions: Mapping[str, Mission], track: bool) -> str:
        """Name of a run, derived from the settings, so that an interrupted run can continue."""
        digests = [
            self._context.sky.catalog.digest,
            *sorted(each.digest for each in missions.values()),
        ]
        short = hashlib.sha256("".join(digests).encode()).hexdigest()[:8]
        return f"{source[:50]}-{'tracked' if track else 'again'}-{short}"
