"""The rates of a sweep as a page of HTML that needs nothing beside it."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from service.errors import BadInput, Fault, shown_value
from studies.mission_rates.plot import abscissa_of, draw
from studies.mission_rates.report import TITLES, heading, meeting, met
from studies.mission_rates.simulation import Plan, Rates

OPTION = "--page"


def checked(plan: Plan, file: Path) -> None:
    """Raise `BadInput` where no page can be written to a file."""
    if file.suffix != ".html":
        fault = Fault(OPTION, "must be the name of an .html file", shown_value(str(file)))
        raise BadInput(fault)
    abscissa_of(plan, OPTION)


def write_page(
    plan: Plan, rates: Sequence[Rates], at_most_ambiguous: float | None, file: Path
) -> None:
    """Write the rates, their picture where a setting has several values, and what meets a share.

    Raises `NotAvailable` where there is a picture and matplotlib is not installed.
    """
    # Text of mission files is escaped; a misspelt name is an error, not an empty string.
    environment = Environment(
        loader=PackageLoader(__package__, "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    share = at_most_ambiguous
    page = environment.get_template("page.html.jinja").render(
        mission=plan.settings[0].mission.name,
        heading=heading(plan),
        picture=_picture(plan, rates),
        names=list(plan.settings[0].values),
        titles=TITLES,
        rates=rates,
        wanted=share is not None,
        meeting=[] if share is None else meeting(rates, share),
        met=[] if share is None else met(rates, share),
    )
    file.write_text(page, encoding="utf-8")


def _picture(plan: Plan, rates: Sequence[Rates]) -> Markup | None:
    if abscissa_of(plan, OPTION) is None:
        return None
    with TemporaryDirectory() as folder:
        drawn = Path(folder) / "rates.svg"
        draw(plan, rates, drawn)
        text = drawn.read_text(encoding="utf-8")
    # matplotlib escapes what it writes; what stands before is the head of a file of its own.
    return Markup(text[text.index("<svg") :])
