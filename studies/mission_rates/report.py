"""Reports of a sweep's identification rates: table, JSON, picture, and self-contained HTML page.

Also the settings that meet a required rate.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from service.cli.markdown import markdown
from service.errors import BadInput, Fault, shown_value
from service.intervals import Interval
from studies.documents import pictures_in
from studies.mission_rates.simulation import OUTCOMES, Plan, Rates, sigobs_arcsec

TITLES = {name: name.replace("_", " ") for name in OUTCOMES}


def meeting(rates: Sequence[Rates], at_most_ambiguous: float) -> list[Rates]:
    """Settings with at most a given share of ambiguous stars, with 95 % confidence.

    The setting with the most rightly identified stars is first.
    """
    found = [each for each in rates if each.ambiguous.high <= at_most_ambiguous]
    return sorted(found, key=lambda each: -each.unique_right.value)


def report_text(plan: Plan, rates: Sequence[Rates], at_most_ambiguous: float | None) -> str:
    """Report of a sweep as text for a terminal."""
    lines = [*heading(plan), "", _table(rates)]
    if at_most_ambiguous is not None:
        lines += ["", *met(rates, at_most_ambiguous)]
    return "\n".join(lines)


def heading(plan: Plan) -> list[str]:
    """Description of a simulation, as lines of text."""
    first = plan.settings[0]
    mission, errors = first.mission, first.errors
    where = "the whole sky"
    if plan.direction_deg is not None:
        ra_deg, dec_deg = plan.direction_deg
        where = f"{plan.within_deg:g} deg about RA {ra_deg:g}, Dec {dec_deg:g} deg"
    statements = {
        "phi_deg": f"phi {errors.phi_deg:g} deg",
        "theta_deg": f"theta {errors.theta_deg:g} deg",
        "psi_deg": f"psi {errors.psi_deg:g} deg",
        "off_axis_deg": f"off axis to {errors.off_axis_deg:g} deg",
        "position_error_arcsec": (
            f"position {errors.position_error_arcsec:.4g} arcsec per axis "
            f"(SIGOBS {sigobs_arcsec(errors):.4g})"
        ),
        "magnitude_error_mag": f"magnitude {errors.magnitude_error_mag:g} mag",
    }
    unswept = [text for name, text in statements.items() if name not in first.values]
    switched = [f"{name} {'on' if is_on else 'off'}" for name, is_on in plan.tests.items()]
    lines = [
        (
            f"{mission.name}, {mission.trackers[0].name}, by {plan.identifier}: {plan.zones} zones "
            f"of {where}, {plan.views} views each, at most {plan.most_stars} stars a view, "
            f"seed {plan.seed}"
        ),
        "Errors that are not swept: " + ("; ".join(unswept) or "none"),
    ]
    return [*lines, "Tests: " + ", ".join(switched)] if switched else lines


def _table(rates: Sequence[Rates]) -> str:
    names = list(rates[0].setting.values)
    header = [*names, "stars", *(f"{title} %" for title in TITLES.values())]
    rows = []
    for each in rates:
        values = [f"{each.setting.values[name]:g}" for name in names]
        shares = [_percent(getattr(each, name)) for name in OUTCOMES]
        rows.append([*values, str(each.stars), *shares])
    return markdown(header, rows) + "\nIn brackets: 95 % intervals."


def _percent(share: Interval) -> str:
    return f"{100 * share.value:.2f} ({100 * share.low:.2f} to {100 * share.high:.2f})"


def met(rates: Sequence[Rates], at_most_ambiguous: float) -> list[str]:
    """Settings that keep ambiguous stars below a share, as lines of text."""
    wanted = f"At most {100 * at_most_ambiguous:g} % ambiguous"
    found = meeting(rates, at_most_ambiguous)
    if found:
        lines = [f"{wanted}, with 95 % confidence, most rightly identified stars first:"]
        lines += [
            f"  {_values(each)}: {_percent(each.ambiguous)} % ambiguous, "
            f"{_percent(each.unique_right)} % unique and right"
            for each in found
        ]
    else:
        lines = [f"{wanted}: no setting, with 95 % confidence."]
    open_ = [
        each for each in rates if each.ambiguous.value <= at_most_ambiguous < each.ambiguous.high
    ]
    if open_:
        settings = "; ".join(_values(each) for each in open_)
        lines.append(f"Not decided by so few stars (raise --stars): {settings}")
    return lines


def _values(each: Rates) -> str:
    values = each.setting.values.items()
    return ", ".join(f"{name}={value:g}" for name, value in values) or "the mission's settings"


def report_json(
    plan: Plan, rates: Sequence[Rates], at_most_ambiguous: float | None
) -> dict[str, Any]:
    """Report of a sweep as plain values; rates are shares from 0 to 1 with 95 % intervals."""
    first = plan.settings[0]
    mission = first.mission
    met = None if at_most_ambiguous is None else meeting(rates, at_most_ambiguous)
    return {
        "mission": mission.name,
        "tracker": mission.trackers[0].name,
        "identifier": plan.identifier,
        "tests": first.mission.tests.model_dump(),
        "direction_deg": plan.direction_deg,
        "within_deg": plan.within_deg,
        "zones": plan.zones,
        "views": plan.views,
        "most_stars": plan.most_stars,
        "seed": plan.seed,
        "settings": [_setting_json(each) for each in rates],
        "at_most_ambiguous": at_most_ambiguous,
        "meeting": None if met is None else [dict(each.setting.values) for each in met],
    }


def _setting_json(each: Rates) -> dict[str, Any]:
    return {
        "swept": dict(each.setting.values),
        "errors": asdict(each.setting.errors),
        "tolerances": each.setting.mission.tolerances.model_dump(),
        "stars": each.stars,
        **{name: asdict(getattr(each, name)) for name in OUTCOMES},
    }


SHOWN = {"ambiguous": "ambiguous", "unmatched": "unmatched", "wrong": "wrong"}
MOST_LINES = 8


def draw(plan: Plan, rates: Sequence[Rates], file: Path) -> None:
    """Draw identification rates with 95 % intervals as SVG, one panel per outcome.

    The last sweep with several values is the abscissa, each combination of the others a line.
    Raises `BadInput` without such a sweep or for too many lines, `NotAvailable` without matplotlib.
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
    """Name of the setting on the abscissa, None without any; checks the output file.

    Raises `BadInput` naming the option if the file has another suffix, or for too many lines.
    """
    if file.suffix != suffix:
        message = f"must be the name of an {suffix} file"
        raise BadInput(Fault(option, message, shown_value(str(file))))
    return abscissa_of(plan, option)


def checked_plot(plan: Plan, file: Path) -> str:
    """Name of the setting on the abscissa; raises `BadInput` if there is nothing to draw."""
    abscissa = checked(plan, "--plot", file, ".svg")
    if abscissa is None:
        raise BadInput(Fault("--plot", "needs a --sweep with several values", str(file)))
    return abscissa


def abscissa_of(plan: Plan, option: str) -> str | None:
    """Last setting with several values, None without any; raises `BadInput` for too many lines."""
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
    """Write the HTML page of a sweep: rates, a picture, and the settings that meet a share.

    Raises `NotAvailable` if there is a picture and matplotlib is not installed.
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
