"""The rates of a sweep as a picture, and as a page of HTML that needs nothing beside it."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from service.errors import BadInput, Fault, shown_value
from studies.documents import pictures_in
from studies.mission_rates.report import TITLES, heading, meeting, met
from studies.mission_rates.simulation import Plan, Rates

SHOWN = {"ambiguous": "ambiguous", "unmatched": "unmatched", "wrong": "wrong"}
MOST_LINES = 8


def draw(plan: Plan, rates: Sequence[Rates], file: Path) -> None:
    """Draw the rates with their 95 % intervals as SVG, a panel an outcome.

    The last sweep with several values is the abscissa, each combination of the others a line.
    Raises `BadInput` where there is none or too many lines, `NotAvailable` without matplotlib.
    """
    abscissa = checked_plot(plan, file)
    lines: dict[str, list[Rates]] = {}
    for each in rates:
        others = {k: v for k, v in each.setting.values.items() if k != abscissa}
        lines.setdefault(", ".join(f"{k} {v:g}" for k, v in others.items()), []).append(each)
    with pictures_in(file.parent, "mission-rates") as pictures:
        figure = pictures.figure(3.4 * len(SHOWN) + 0.6, 3.6)
        axes = figure.subplots(1, len(SHOWN), squeeze=False)[0]
        for axis, (name, title) in zip(axes, SHOWN.items(), strict=True):
            for label, line in lines.items():
                shares = [getattr(each, name) for each in line]
                value = 100.0 * np.array([share.value for share in shares])
                low = value - 100.0 * np.array([share.low for share in shares])
                high = 100.0 * np.array([share.high for share in shares]) - value
                x = [each.setting.values[abscissa] for each in line]
                reach = np.maximum([low, high], 0.0)
                axis.errorbar(x, value, yerr=reach, marker="o", ms=3, capsize=2, label=label)
            axis.set(title=title, xlabel=abscissa)
            axis.set_ylim(bottom=0.0)
        axes[0].set_ylabel("stars (%)")
        if len(lines) > 1:
            axes[0].legend(fontsize=7)
        mission = plan.settings[0].mission.name
        figure.suptitle(f"{mission} by {plan.identifier}: rates with 95 % intervals", fontsize=10)
        pictures.save(figure, file.stem)


def checked(plan: Plan, option: str, file: Path, suffix: str) -> str | None:
    """The name of the setting that is the abscissa, if there is one.

    Raises `BadInput` naming the option where the file has another suffix, or for many lines.
    """
    if file.suffix != suffix:
        message = f"must be the name of an {suffix} file"
        raise BadInput(Fault(option, message, shown_value(str(file))))
    return abscissa_of(plan, option)


def checked_plot(plan: Plan, file: Path) -> str:
    """The name of the setting that is the abscissa; raises `BadInput` where nothing is drawn."""
    abscissa = checked(plan, "--plot", file, ".svg")
    if abscissa is None:
        raise BadInput(Fault("--plot", "needs a --sweep with several values", str(file)))
    return abscissa


def abscissa_of(plan: Plan, option: str) -> str | None:
    """The last setting with several values, if there is one; raises `BadInput` for many lines."""
    varied = {
        name: len({setting.values[name] for setting in plan.settings})
        for name in plan.settings[0].values
    }
    several = [name for name, count in varied.items() if count > 1]
    if not several:
        return None
    lines = len(plan.settings) // varied[several[-1]]
    if lines > MOST_LINES:
        message = f"shows at most {MOST_LINES} lines; sweep fewer values beside {several[-1]}"
        raise BadInput(Fault(option, message, str(lines)))
    return several[-1]


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
    if abscissa_of(plan, "--page") is None:
        return None
    with TemporaryDirectory() as folder:
        drawn = Path(folder) / "rates.svg"
        draw(plan, rates, drawn)
        text = drawn.read_text(encoding="utf-8")
    # matplotlib escapes what it writes; what stands before is the head of a file of its own.
    return Markup(text[text.index("<svg") :])
