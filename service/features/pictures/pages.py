"""Console page that solves pictures of any camera, and the frame on the page of its batch."""

from collections.abc import Iterator

from starlette.responses import Response

from service.contract.answers import Answer, Result
from service.web.console.page import (
    HEADERS,
    ContextDep,
    FromQuery,
    PageContext,
    PageQuery,
    Panel,
    console_page,
)
from service.web.requests.access import Policy

# The script shows the drawn picture, which no address of the service has.
_POLICY = HEADERS["Content-Security-Policy"].replace("img-src 'self'", "img-src 'self' blob:")


@console_page("/pictures", "Pictures", Policy("read", "nothing"), position=60)
def pictures_page(query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """Page on which a dropped picture is solved: its attitude, stars and lens, or what to try."""
    missions = context.app.missions
    cameras = [
        (name, tracker.camera)
        for name in context.spacecraft
        if name in missions
        for tracker in [each for each in missions[name].trackers if each.camera][:1]
    ]
    page = context.rendered(
        "pictures.html.jinja",
        query.run,
        cameras=cameras,
        most_mb=context.app.settings.frame_mb,
        most_megapixels=context.app.settings.frame_megapixels,
    )
    page.headers["Content-Security-Policy"] = _POLICY
    return page


def frame_of_batch(context: PageContext, record: Result, tried: Answer | None) -> Iterator[Panel]:
    """Panel with the frame that a batch was made from, if it was."""
    if record.frame:
        answer = record.answer
        values = {"id": answer.id, "observed": answer.counts.observed, "is_what_if": bool(tried)}
        yield Panel("_frame_of_batch.html.jinja", values)


PANELS = {"batch_page": frame_of_batch}
