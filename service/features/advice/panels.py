"""Panel of a spacecraft page that explains ambiguous stars."""

from collections.abc import Iterator

from service.features.advice.part import AdviceService
from service.web.console.page import PageContext, Panel
from service.web.console.pages.spacecraft import PeriodBefore, ShownPeriod


def ambiguity_of_period(
    context: PageContext, name: str, run: str, shown: ShownPeriod, before: PeriodBefore
) -> Iterator[Panel]:
    """Panel that compares ambiguous stars of a period with an earlier one, with causes."""
    found = context.app.part(AdviceService).ambiguity(
        name, run, shown.start, shown.end, before.shift_s
    )
    if found.parts:
        yield Panel("_ambiguity.html.jinja", found)


PANELS = {"ambiguity": ambiguity_of_period}
