"""Pictures of the paper's figures: our lines, and the end points given in its text."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from studies.documents import pictures_in
from studies.ptp_2015.comparison import FieldShare, Tally
from studies.ptp_2015.printed import Ends, the_ptp_paper
from studies.ptp_2015.projections import Projections, draw_figure_6, draw_figure_7

COLORS = {
    "PTP": "#0b5394",
    "P-vector": "#b45309",
    "planar triangle": "#38761d",
    "Liebe's triangles": "#741b47",
    "pyramid": "#444444",
}
PlottedSeries = dict[str, Sequence[Tally] | npt.NDArray[np.int64] | Projections]


def draw(found: PlottedSeries, folder: Path) -> list[Path]:
    """Draw all figures for which there are results; returns the SVG files written.

    Raises `NotAvailable` without matplotlib.
    """
    paper = the_ptp_paper()
    with pictures_in(folder, "ptp") as pictures:
        for name, shown in found.items():
            if not name.startswith("figure"):
                continue
            figure = pictures.figure(7.4, 3.4)
            if isinstance(shown, Projections):
                (draw_figure_6 if name == "figure-6" else draw_figure_7)(figure, shown)
            elif isinstance(shown, np.ndarray):
                _histogram(figure.subplots(), shown)
            else:
                left, right = figure.subplots(1, 2, sharey=True)
                for axis, word in ((left, "strict"), (right, "checked")):
                    if name == "figure-11":
                        _by_stars(axis, shown, word)
                    elif name == "figure-12":
                        _lines(axis, shown, word, "position_px", paper.figure_12)
                        axis.set_xlabel("noise of position (px)")
                    else:
                        _lines(axis, shown, word, "magnitude_sigma_mag", paper.figure_13)
                        axis.set_xlabel("noise of magnitude (mag)")
                    axis.set_title(f"{name.capitalize().replace('-', ' ')}: {word}")
                left.set_ylabel("fields (%)")
                if left.get_legend_handles_labels()[0]:
                    left.legend(fontsize=7)
            pictures.save(figure, f"ptp-{name}")
    return pictures.written


def _histogram(axis: Any, stars: npt.NDArray[np.int64]) -> None:
    printed = the_ptp_paper().figure_10
    edges = np.arange(stars.max() + 2) - 0.5
    axis.hist(stars, edges, weights=np.full(len(stars), 100.0 / len(stars)), color=COLORS["PTP"])
    axis.axvline(stars.mean(), color=COLORS["PTP"], ls="--", label=f"mean {stars.mean():.2f}")
    label = f"the paper's mean, {printed.mean}"
    axis.axvline(printed.mean, color=COLORS["P-vector"], ls="--", label=label)
    axis.set(title="Figure 10: stars in the field of view", xlabel="stars", ylabel="fields (%)")
    axis.legend(fontsize=7)


def _by_algorithm(tallies: Sequence[Tally]) -> dict[str, list[Tally]]:
    names = dict.fromkeys(tally.algorithm for tally in tallies)
    return {name: [tally for tally in tallies if tally.algorithm == name] for name in names}


def _band(axis: Any, x: Sequence[float], rates: Sequence[FieldShare], name: str) -> None:
    low, high = zip(*(rate.interval for rate in rates), strict=True)
    color = COLORS[name]
    axis.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    axis.plot(x, [rate.percent for rate in rates], color=color, marker=".", label=name)


def _lines(axis: Any, tallies: Sequence[Tally], word: str, field: str, printed: Ends) -> None:
    for name, mine in _by_algorithm(tallies).items():
        mine.sort(key=lambda tally: float(getattr(tally.case, field)))
        x = [float(getattr(tally.case, field)) for tally in mine]
        _band(axis, x, [getattr(tally, word) for tally in mine], name)
        if name in printed:
            ends = [x[0], x[-1]]
            label = None if word == "checked" else f"{name}, paper"
            axis.plot(ends, printed[name], "o", mfc="none", color=COLORS[name], label=label)
    axis.set_ylim(0, 102)


def _by_stars(axis: Any, tallies: Sequence[Tally], word: str) -> None:
    for tally in tallies:
        parts = {stars: tally.of_fields_with(stars, stars) for stars in range(3, 21)}
        kept = {stars: part for stars, part in parts.items() if len(part.rows) >= 10}
        rates = [getattr(part, word) for part in kept.values()]
        if kept:
            _band(axis, list(kept), rates, tally.algorithm)
    axis.set(xlabel="stars in the field", ylim=(0, 102))
