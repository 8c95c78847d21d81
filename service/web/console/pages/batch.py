"""Pages of batches: the list, and one batch with star field, votes and what-if."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import Path
from msgspec import json, structs
from pydantic import Field
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from service.app.context import ALL_RUNS
from service.contract.answers import Answer, Result, Summary
from service.contract.answers import Star as FoundStar
from service.contract.base import Page
from service.errors import BadBatch, BadInput, Fault, NotFound, shown_value
from service.identify.hypotheses.verified import UNIQUE_PROBABILITY
from service.observations.schema import LIVE, Key
from service.storage.queries.results import OutcomeName, StatusName
from service.storage.queries.star_field import ObservedStarPlace, StarField
from service.storage.recording.ids import is_ulid
from service.times import Utc, recorded_utc
from service.trends.quantities import QUANTITIES
from service.vectors import matrix_from_quaternion, to_ra_dec
from service.web.console.charts.sky_chart import sky_chart
from service.web.console.formatting import arcsec, share, with_day_of_year
from service.web.console.options import (
    asked_options,
    batch_settings,
    changed_options,
    fields_of,
    toml_of,
)
from service.web.console.page import (
    ContextDep,
    FromQuery,
    PageContext,
    PeriodQuery,
    console_page,
    typed_utc,
)
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Cursor

VIEWS = ("all", "field")
"""Contents of the chart to choose from: all candidates, or the field of view only."""

MUCH_WORSE = 2.0
"""Greatest ratio of a residual to the predicted one without a warning."""
STATUSES = ("good", "suspect", "none")
"""Statuses of an attitude, the best first."""
SCALE = 3.0
"""Least range of the bars of the trackers' residuals, in predicted residuals."""

ResultId = Annotated[str, Path()]


@dataclass(frozen=True)
class VoteRow:
    """Row of the vote table: observed star, its identification, and the previous one."""

    tracker: str
    number: int
    seen: ObservedStarPlace
    found: FoundStar
    before: FoundStar | None
    catalog_magnitude: float | None

    @property
    def why(self) -> str:
        """Reason why a star is not unique, its rivals, and a remedy; empty for a unique star."""
        found = self.found
        if found.outcome == "unique":
            return ""
        rivals = found.rivals or []
        chances = found.rival_probabilities or []
        if chances:
            told = [f"{star} {share(chance)}" for star, chance in zip(rivals, chances, strict=True)]
            told.append(f"no star {share(max(0.0, 1.0 - sum(chances)))}")
            return (
                f"{', '.join(told)}; unique needs {share(UNIQUE_PROBABILITY)}: a smaller sigma, or "
                "more stars in the field that agree with one of them"
            )
        if rivals:
            votes = "one vote" if found.votes == 1 else f"{found.votes} votes"
            return (
                f"{', '.join(rivals)} have {votes} each; unique needs one star with "
                "more: narrower tolerances, or more stars in the field"
            )
        if found.probability is not None:
            return f"no star {share(found.probability)}"
        return "no star of the catalog here has a vote"

    @property
    def changed(self) -> bool:
        """True if a what-if identifies the star differently."""
        return self.before is not None and (
            (self.found.outcome, self.found.star) != (self.before.outcome, self.before.star)
        )


@console_page("/batches/{id}", "Batch", Policy("read", "result"), section="/batches")
def batch_page(request: Request, id: ResultId, context: ContextDep) -> Response:
    """Page of one result: star field, votes, attitude, provenance; or a what-if with options.

    An id from the sender of a batch leads to the search for it.
    """
    query = dict(request.query_params)
    if not is_ulid(id):
        if not named(context, BatchesQuery(), id):
            raise NotFound(f"there is no batch with the id {shown_value(id)}")
        asked = {"run": query.get("run", LIVE), "find": id}
        return RedirectResponse(f"/batches?{urlencode(asked)}", 303)
    view = query.pop("view", "all")
    if view not in VIEWS:
        raise BadBatch(Fault("view", f"must be {' or '.join(VIEWS)}", shown_value(view)))
    query.pop("run", None)
    record = context.app.results.get(id)
    answer = record.answer
    asked = asked_options(query)
    held = context.app.results.settings_for(id)
    options = changed_options(asked, held)
    tried = None
    if options.model_fields_set:
        # Without an id, unlike one that is recorded.
        tried = json.decode(context.app.results.what_if(id, options).body, type=Answer)
    shown = tried or answer
    field = context.app.results.star_field(id, tried)
    mission = context.app.context.known[answer.spacecraft]
    fields = fields_of(asked, batch_settings(held), mission=mission)
    return context.rendered(
        "batch.html.jinja",
        answer.run,
        record=record,
        answer=answer,
        tried=tried,
        shown=shown,
        trackers=_trackers(context.app.results.trackers(id, tried)),
        stars=_stars(shown, answer if tried else None, field),
        measured=record.input.get("measurement"),
        charts=[sky_chart(each, field.through, view) for each in field.trackers],
        view=view,
        link_to=lambda **more: f"/batches/{id}?{urlencode(query | more)}",
        field=field,
        fields=fields,
        options=options.model_dump(exclude_none=True, exclude_unset=True),
        toml=toml_of(fields),
        adoption=adoption(answer, shown),
        signatures=context.app.results.signatures(
            {each.id: each.parent for each in record.what_ifs}
        ),
        putting_back=_putting_back(context, record),
        pointing=_pointing(shown),
        timings_us=structs.asdict(shown.timings_us),
        panels=context.panels("batch_page", record, tried),
        around=context.app.results.neighbours(id),
        other_settings=mission.digest != answer.provenance.mission,
    )


def adoption(before: Answer, after: Answer) -> list[str]:
    """Sentences about the changes by adopting a what-if."""
    words = ("unique", "ambiguous", "unmatched")
    changes = [
        f"{word} stars {getattr(before.counts, word)} to {getattr(after.counts, word)}"
        for word in words
        if getattr(before.counts, word) != getattr(after.counts, word)
    ]
    statuses = [_status(each) for each in (before, after)]
    if statuses[0] != statuses[1]:
        changes.append(f"attitude {statuses[0]} to {statuses[1]}")
    return [
        *_worse(before, after),
        f"1 batch changes: {', '.join(changes) or 'its counts and its status stay the same'}.",
        f"Lists and trends of {after.spacecraft} show it at {with_day_of_year(after.time)} UTC.",
        (
            "The mission's settings stay: other batches do not change. "
            "To undo it, adopt the former result, which stays readable."
        ),
    ]


def _worse(before: Answer, after: Answer) -> Iterator[str]:
    """Warnings, with both figures, of stars, status and residual that are worse in the result."""
    stars = before.counts.unique, after.counts.unique
    if stars[1] < stars[0]:
        yield f"▲ Fewer stars are identified: {stars[0]} to {stars[1]} of {after.counts.observed}."
    if STATUSES.index(_status(after)) > STATUSES.index(_status(before)):
        yield f"▲ The attitude is worse: {_status(before)} to {_status(after)}."
    if after.attitude is None or after.attitude.residual_rms_arcsec is None:
        return
    new, predicted = after.attitude.residual_rms_arcsec, after.attitude.predicted_rms_arcsec
    old = before.attitude.residual_rms_arcsec if before.attitude else None
    if old is not None and new > old and arcsec(new) != arcsec(old):
        yield f"▲ The attitude fits its stars worse: residual rms {arcsec(old)} to {arcsec(new)}."
    elif old is None and predicted is not None and new > MUCH_WORSE * predicted:
        yield f"▲ The attitude fits its stars badly: residual rms {arcsec(new)}."


def _status(answer: Answer) -> str:
    return "none" if answer.attitude is None else answer.attitude.status


def _putting_back(context: PageContext, record: Result) -> list[str]:
    """Sentences about the changes by putting the former result back; none for any other result."""
    if record.parent is None or not record.current:
        return []
    return adoption(record.answer, context.app.results.get(record.parent).answer)


def _stars(shown: Answer, before: Answer | None, field: StarField) -> list[VoteRow]:
    stars = []
    for index, tracker in enumerate(shown.observations):
        drawn = field.trackers[index]
        magnitudes = {each.id: each.magnitude for each in drawn.catalog}
        for k, found in enumerate(tracker.stars):
            stars.append(
                VoteRow(
                    tracker.tracker,
                    k + 1,
                    drawn.observed[k],
                    found,
                    None if before is None else before.observations[index].stars[k],
                    magnitudes.get(found.star.id) if found.star else None,
                )
            )
    return stars


def _trackers(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Values of each tracker, with its residual over the predicted one, on a common scale."""
    ratio_of = QUANTITIES["residual_ratio"].value_of
    ratios = [ratio_of(row) for row in rows]
    scale = max(SCALE, *(each or 0.0 for each in ratios)) if ratios else SCALE
    return [
        row | {"ratio": ratio, "width": (ratio or 0.0) / scale, "mark": 1.0 / scale}
        for row, ratio in zip(rows, ratios, strict=True)
    ]


def _pointing(shown: Answer) -> list[dict[str, Any]]:
    """Directions of the body axes by each method, as readable form of the quaternions."""
    solved = shown.attitude
    if solved is None:
        return []
    rows = []
    by_method = {"quest": solved.quest, "triad": solved.triad}
    if solved.quest is None:
        by_method = {solved.method: solved.quaternion}
    for method, quaternion in by_method.items():
        if quaternion is None:
            continue
        attitude = matrix_from_quaternion(quaternion)
        axes = {}
        for name, axis in zip("XYZ", attitude, strict=True):
            ra_deg, dec_deg = to_ra_dec(axis)
            axes[name] = (float(ra_deg), float(dec_deg))
        rows.append({"method": method, "quaternion": quaternion, "axes": axes})
    return rows


ROWS = 50
MOST_NEAREST = 20
"""Greatest number of spacecraft whose batches nearest to a time are listed."""
Any_ = Literal[""]
"""Type of an empty form field, which selects any value."""


class BatchesQuery(PeriodQuery):
    """Query that selects batches; empty form fields are left out."""

    spacecraft: Key | Any_ = ""
    outcome: OutcomeName | Any_ = ""
    status: StatusName | Any_ = ""
    adopted: bool = False
    find: Annotated[str, Field(max_length=200)] = ""
    """Text that the search form sends: the id of a batch or of a result, or a time."""
    cursor: Cursor = None


@console_page("/batches", "Batches", Policy("read", "nothing"), position=30)
def batches_page(query: FromQuery[BatchesQuery], context: ContextDep) -> Response:
    """Page with the batches of a run, newest first."""
    query = query.model_copy(update={"spacecraft": context.listed(query.spacecraft)})
    moment, nearest = None, list[tuple[Summary, float]]()
    if text := query.find.strip():
        try:
            latest = context.app.results.page(
                spacecraft=query.spacecraft or None, run=query.run, limit=1
            ).items
            moment = typed_utc(text, "find", recorded_utc(latest[0].time) if latest else None)
        except BadInput:
            found = named(context, query, text)
            if len(found) == 1:
                address = f"/batches/{found[0].id}?{urlencode({'run': found[0].run})}"
                return RedirectResponse(address, 303)
        else:
            nearest = _nearest(context, query, moment)
            found = [each for each, _ in nearest]
        page = Page(found, None)
    else:
        page = context.app.results.page(
            spacecraft=query.spacecraft or None,
            run=query.run,
            start=query.bounds["start"],
            end=query.bounds["end"],
            outcome=query.outcome or None,
            status=query.status or None,
            adopted=query.adopted,
            limit=ROWS,
            cursor=query.cursor,
        )
    return context.rendered(
        "batches.html.jinja",
        query.run,
        query=query,
        page=page,
        signatures=context.app.results.signatures({each.id: each.parent for each in page.items}),
        moment=moment,
        nearest=nearest,
        spacecraft=context.spacecraft,
    )


def _nearest(context: PageContext, query: BatchesQuery, moment: Utc) -> list[tuple[Summary, float]]:
    """Batches about a time, the nearer first, and their offsets in seconds.

    They are the batches before and after it of the chosen spacecraft, or the nearest one of each.
    """
    offsets = []
    for name in [query.spacecraft] if query.spacecraft else context.spacecraft:
        around = context.app.results.around(moment, query.run, name)
        sides = [
            (each, (recorded_utc(each.time).tai_ns - moment.tai_ns) * 1e-9)
            for each in (around.earlier, around.later)
            if each is not None
        ]
        sides.sort(key=lambda each: abs(each[1]))
        offsets += sides if query.spacecraft else sides[:1]
    return sorted(offsets, key=lambda each: abs(each[1]))[:MOST_NEAREST]


def named(context: PageContext, query: BatchesQuery, text: str) -> list[Summary]:
    """Batches with an id, of the shown run if possible, otherwise of all runs."""
    name = context.app.results.spacecraft_of(text)
    if name is not None and context.caller.may_see(name):
        answer = context.app.results.get(text).answer
        return _listed(context, answer.run, answer.spacecraft, answer.batch)
    # The database has an index of these ids for one spacecraft.
    names = [query.spacecraft] if query.spacecraft else context.spacecraft
    found = [each for name in names for each in _listed(context, ALL_RUNS, name, text)]
    return [each for each in found if each.run == query.run] or found


def _listed(context: PageContext, run: str, spacecraft: str | None, text: str) -> list[Summary]:
    page = context.app.results.page(spacecraft=spacecraft, run=run, batch=text, limit=ROWS)
    return [each for each in page.items if context.caller.may_see(each.spacecraft)]
