"""Panel with the reprocessings into the archive, on the page of runs."""

from collections.abc import Iterator

from service.features.archive.part import Reprocessings
from service.times import utc_now
from service.web.console.page import PageContext, Panel


def reprocessings_of_archive(context: PageContext) -> Iterator[Panel]:
    """Panel with the progress of each reprocessing, for callers who may see every spacecraft."""
    if context.caller.spacecraft is not None:
        return
    if found := context.app.part(Reprocessings).all():
        yield Panel("_reprocessings.html.jinja", {"reprocessings": found, "now": utc_now()})


PANELS = {"runs_page": reprocessings_of_archive}
