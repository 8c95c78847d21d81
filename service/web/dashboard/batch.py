"""The page of one batch: its stars in the sky, the votes for each, and what other settings do."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import quote, urlencode

import msgspec
from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from service.errors import BadBatch, Fault, shown_value
from service.vectors import matrix_from_quaternion, to_ra_dec
from service.web.dashboard.options import (
    asked_options,
    changed_options,
    fields_of,
    settings_of,
    toml_of,
)
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery
from service.web.dashboard.sky_chart import sky_chart

router = APIRouter(include_in_schema=False, route_class=PageRoute)

VIEWS = ("all", "field")
"""How much of the sky the picture shows: whatever the answer speaks of, or the field of view."""

ResultId = Annotated[str, Path()]


@dataclass(frozen=True)
class Star:
    """One row of the vote table: what was seen, what was made of it, and what was made before."""

    tracker: str
    number: int
    seen: Mapping[str, Any]
    found: Mapping[str, Any]
    before: Mapping[str, Any] | None
    catalog_magnitude: float | None

    @property
    def changed(self) -> bool:
        """Whether a what-if has made something else of it."""
        return self.before is not None and (
            (self.found["outcome"], self.found["star"])
            != (self.before["outcome"], self.before["star"])
        )


@router.get("/batches/{id}")
def batch_page(request: Request, id: ResultId, desk: AtDesk) -> Response:
    """One result: star field, votes, attitude, provenance; with options in the query, a what-if."""
    query = dict(request.query_params)
    view = query.pop("view", "all")
    if view not in VIEWS:
        raise BadBatch(Fault("view", f"must be {' or '.join(VIEWS)}", shown_value(view)))
    query.pop("run", None)
    record = desk.operations.batch(id)
    answer = record["answer"]
    asked = asked_options(query)
    held = desk.operations.settings_for(id)
    options = changed_options(asked, held)
    tried = None
    if options.model_fields_set:
        tried = msgspec.json.decode(desk.operations.what_if(id, options).body)
    shown = tried or answer
    field = desk.operations.star_field(id, tried)
    fields = fields_of(asked, settings_of(held))
    shell = desk.shell(answer["run"], "/batches")
    return rendered(
        "batch.html.jinja",
        shell,
        record=record,
        answer=answer,
        tried=tried,
        shown=shown,
        stars=_stars(shown, answer if tried else None, field),
        charts=[sky_chart(each, field["through"], view) for each in field["trackers"]],
        view=view,
        here=lambda **more: f"/batches/{id}?{urlencode(query | more)}",
        field=field,
        fields=fields,
        options=options.model_dump(exclude_none=True, exclude_unset=True),
        toml=toml_of(fields),
        pointing=_pointing(shown),
        around=desk.operations.neighbours(id),
        other_settings=desk.operations.missions[answer["spacecraft"]].digest
        != answer["provenance"]["mission"],
    )


@router.get("/latest/{name}")
def latest_batch(name: str, query: Annotated[RunQuery, InQuery()], desk: AtDesk) -> Response:
    """Leads to the latest batch of a spacecraft in a run."""
    items = desk.operations.batches(spacecraft=name, run=query.run, limit=1).items
    address = f"/batches/{items[0]['id']}" if items else f"/spacecraft/{quote(name)}"
    return RedirectResponse(f"{address}?{urlencode({'run': query.run})}", 303)


def _stars(
    shown: Mapping[str, Any], before: Mapping[str, Any] | None, field: Mapping[str, Any]
) -> list[Star]:
    stars = []
    for index, tracker in enumerate(shown["observations"]):
        drawn = field["trackers"][index]
        magnitudes = {each["id"]: each["magnitude"] for each in drawn["catalog"]}
        for k, found in enumerate(tracker["stars"]):
            stars.append(
                Star(
                    tracker["tracker"],
                    k + 1,
                    drawn["observed"][k],
                    found,
                    None if before is None else before["observations"][index]["stars"][k],
                    magnitudes.get(found["star"]["id"]) if found["star"] else None,
                )
            )
    return stars


def _pointing(shown: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Where the body axes point by each method: what a quaternion hides from the eye."""
    solved = shown["attitude"]
    if solved is None:
        return []
    rows = []
    for method in ("quest", "triad"):
        attitude = matrix_from_quaternion(solved[method])
        axes = {}
        for name, axis in zip("XYZ", attitude, strict=True):
            ra_deg, dec_deg = to_ra_dec(axis)
            axes[name] = (float(ra_deg), float(dec_deg))
        rows.append({"method": method, "quaternion": solved[method], "axes": axes})
    return rows
