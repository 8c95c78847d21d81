"""The rates of a sweep as a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.errors import BadInput, Fault, shown_value
from service.simulate.drawing import pictures_in
from studies.mission_rates.simulation import Plan, Rates

SHOWN = {"ambiguous": "ambiguous", "unmatched": "unmatched", "wrong": "wrong"}
MOST_LINES = 8


def draw(plan: Plan, rates: Sequence[Rates], file: Path) -> None:
    """Draw the rates with their 95 % intervals as SVG, a panel an outcome.

    The last sweep with several values is the abscissa, each combination of the others a line.
    Raises `BadInput` where there is none or too many lines, `NotAvailable` without matplotlib.
    """
    abscissa = checked(plan, file)
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


def checked(plan: Plan, file: Path) -> str:
    """The name of the setting that is the abscissa; raises `BadInput` where nothing is drawn."""
    if file.suffix != ".svg":
        raise BadInput(Fault("--plot", "must be the name of an .svg file", shown_value(str(file))))
    abscissa = abscissa_of(plan, "--plot")
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
