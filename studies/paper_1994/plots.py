"""Pictures of identification rates against each error, the paper's and ours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.documents import pictures_in
from studies.paper_1994.printed import Run
from studies.paper_1994.tally import Tally, spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOT_IDENTIFIED, WRONG = "#0b5394", "#b45309"
ANGLES = ("φ, about Z", "θ, about Y", "ψ, about X")
BASELINE_ARCSEC = (40, 40, 60)


@dataclass(frozen=True)
class Panel:
    """One panel of a picture: the runs shown, and their values on the abscissa."""

    title: str
    unit: str
    shows: Callable[[Run], bool]
    place: Callable[[Run], float]


def _one_angle(k: int) -> Panel:
    def shows(run: Run) -> bool:
        others = all(run.rotation_arcsec[i] == BASELINE_ARCSEC[i] for i in range(3) if i != k)
        return run.table == "2" and run.geometry and others

    return Panel(
        f"Table 2, cap: {ANGLES[k]}", "error (°)", shows, lambda run: run.rotation_arcsec[k] / 3600
    )


def _table(table: str, title: str, unit: str, place: Callable[[Run], float]) -> Panel:
    return Panel(title, unit, lambda run: run.table == table and run.geometry, place)


PICTURES = {
    "paper-attitude": (
        *(_one_angle(k) for k in (2, 0, 1)),
        _table(
            "3", "Table 3, band: φ = θ, any ψ", "error (°)", lambda r: r.rotation_arcsec[0] / 3600
        ),
    ),
    "paper-magnitude": (
        _table("4", "Table 4, cap", "SIGMAG (mag)", lambda run: run.sigma_mag),
        _table("5", "Table 5, band", "SIGMAG (mag)", lambda run: run.sigma_mag),
    ),
    "paper-position": (
        _table("6", "Table 6, cap", "SIGOBS (″)", lambda run: run.sigma_arcsec),
        _table("7", "Table 7, band", "SIGOBS (″)", lambda run: run.sigma_arcsec),
    ),
}
PLACES = "paper-places"


def draw(tallies: Sequence[Tally], folder: Path) -> list[Path]:
    """Draw all pictures for which there are results; returns the SVG files written.

    Raises `NotAvailable` without matplotlib.
    """
    with pictures_in(folder, "paper") as pictures:
        for name, panels in PICTURES.items():
            shown = [(p, [t for t in tallies if p.shows(t.run)]) for p in panels]
            shown = [(panel, mine) for panel, mine in shown if mine]
            if shown:
                figure = pictures.figure(3.4 * len(shown) + 0.6, 3.3)
                axes = figure.subplots(1, len(shown), squeeze=False)[0]
                for axis, (panel, mine) in zip(axes, shown, strict=True):
                    _draw_panel(axis, panel, mine)
                pictures.save(figure, name)
        places = [tally for tally in tallies if tally.run.number >= 8]
        if places:
            figure = pictures.figure(9.0, 0.22 * len(places) + 1.2)
            _draw_places(figure.subplots(1, 2, sharey=True), places)
            pictures.save(figure, PLACES)
    return pictures.written


def _percent(tallies: Sequence[Tally], k: int) -> tuple[Any, Any, Any]:
    """Printed rates, our rates, and the standard deviation of an experiment of the paper's size."""
    printed, ours, sigma = [], [], []
    for tally in tallies:
        counts = tally.run.printed
        printed.append(100.0 * (counts.ambiguous, counts.misidentified)[k] / counts.stars)
        size = spread(tally)
        ours.append(100.0 * size.mean[k] / size.stars)
        sigma.append(100.0 * np.sqrt(size.covariance[k, k]) / size.stars)
    return np.array(printed), np.array(ours), np.array(sigma)


def _circles(color: str) -> dict[str, Any]:
    # Circles at zero are drawn whole.
    return {"color": color, "marker": "o", "ls": "", "mfc": "none", "ms": 4.5, "clip_on": False}


def _draw_panel(axis: "Axes", panel: Panel, tallies: Sequence[Tally]) -> None:
    ordered = sorted(tallies, key=lambda tally: panel.place(tally.run))
    x = np.array([panel.place(tally.run) for tally in ordered])
    for k, (label, color) in enumerate((("not identified", NOT_IDENTIFIED), ("wrong", WRONG))):
        printed, ours, sigma = _percent(ordered, k)
        # Runs at one place, Table 3's four psi, are drawn as one.
        at = np.unique(x)
        ours, sigma = (np.array([each[x == one].mean() for one in at]) for each in (ours, sigma))
        low, high = np.maximum(ours - 1.96 * sigma, 0.0), ours + 1.96 * sigma
        axis.fill_between(at, low, high, color=color, alpha=0.15, linewidth=0)
        axis.plot(at, ours, color=color, label=f"{label}, ours")
        axis.plot(x, printed, label=f"{label}, 1994", **_circles(color))
    axis.set(title=panel.title, xlabel=panel.unit, ylabel="stars (%)")
    axis.set_ylim(bottom=0.0)
    axis.legend(fontsize=7, loc="upper left")


def _draw_places(axes: Any, tallies: Sequence[Tally]) -> None:
    y = np.arange(len(tallies))[::-1]
    for k, (title, color) in enumerate((("not identified", NOT_IDENTIFIED), ("wrong", WRONG))):
        printed, ours, sigma = _percent(tallies, k)
        reach = np.stack([np.minimum(1.96 * sigma, ours), 1.96 * sigma])
        axes[k].errorbar(
            ours, y, xerr=reach, fmt="|", color=color, alpha=0.7, label="ours, 95 % of experiments"
        )
        axes[k].plot(printed, y, label="1994", **_circles(color))
        axes[k].set(title=f"Tables 8 to 10: {title}", xlabel="stars (%)")
        axes[k].set_xlim(left=0.0)
        axes[k].legend(fontsize=7, loc="upper right")
    axes[0].set_yticks(y, [f"{tally.run.table} {tally.run.run}" for tally in tallies])
