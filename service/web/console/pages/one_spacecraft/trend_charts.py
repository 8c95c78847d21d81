"""The charts of trends: which quantities each shows, and where it reads their history."""

from collections.abc import Sequence
from typing import Any
from urllib.parse import quote, urlencode

from service.alarms.quantities import QUANTITIES, trend_names
from service.times import Utc
from service.web.console.page_context import LIVE

POINTS = 240
"""The most points of a curve: as many as a chart can show."""
CHARTS: Sequence[tuple[str, str, tuple[str, ...]]] = (
    ("stars", "Ambiguous and unmatched stars", ("ambiguous_share", "unmatched_share")),
    (
        "batches",
        "Batches without an attitude, or with a suspect one",
        ("no_attitude_share", "suspect_share"),
    ),
    (
        "residual",
        "Residual rms and predicted rms",
        ("residual_rms_arcsec", "predicted_rms_arcsec"),
    ),
    ("magnitude", "Magnitude offset, observed minus catalog", ("magnitude_offset_mag",)),
    ("scale", "Scale offset, observed over catalog", ("scale_offset_ppm",)),
    ("alignment", "Angle between trackers, observed minus catalog", ("alignment_offset_arcsec",)),
    ("a-priori", "Angle from the a priori attitude", ("a_priori_angle_deg",)),
    ("rate", "Batches per hour", ("batches_per_hour",)),
)
"""Id, title and quantities of the charts; every other quantity gets one of its own."""
UNITS = {"1": "", "arcsec": "″", "deg": "°", "mag": " mag", "ppm": " ppm"}


TRACKER_CHARTS = {"batches": "Batches in which the tracker disagrees with the others"}
"""Titles that differ for the quantities of one tracker."""


def charts(tracker: str | None = None) -> list[dict[str, Any]]:
    """The charts of every quantity that has a history, or that a tracker has."""
    shown = {name for _, _, names in CHARTS for name in names}
    others = [
        (name.replace("_", "-"), QUANTITIES[name].label.capitalize(), (name,))
        for name in trend_names()
        if name not in shown
    ]
    if tracker is None:
        return [_chart(*each) for each in (*CHARTS, *others)]
    of_tracker = [
        (id, TRACKER_CHARTS.get(id, title), [name for name in names if QUANTITIES[name].by_tracker])
        for id, title, names in (*CHARTS, *others)
    ]
    return [_chart(*each) for each in of_tracker if each[-1]]


def charts_by_quantity() -> dict[str, dict[str, Any]]:
    """The chart of each quantity that has a history, by itself."""
    return {
        quantity["name"]: chart
        | {"title": quantity["label"].capitalize(), "quantities": [quantity]}
        for chart in charts()
        for quantity in chart["quantities"]
    }


def _chart(id: str, title: str, names: Sequence[str]) -> dict[str, Any]:
    first = QUANTITIES[names[0]]
    return {
        "id": id,
        "title": title,
        "percent": first.is_share,
        "unit": " %" if first.is_share else UNITS.get(first.unit, f" {first.unit}"),
        "quantities": [{"name": name, "label": QUANTITIES[name].label} for name in names],
    }


def history_address(
    name: str, run: str, tracker: str | None, start: Utc, end: Utc, **more: object
) -> str:
    """The address of the history of a period, as its charts read it."""
    asked: dict[str, object] = {} if run == LIVE else {"run": run}
    if tracker:
        asked["tracker"] = tracker
    asked |= {"start": start.text, "end": end.text, "size": POINTS} | more
    return f"/api/v1/spacecraft/{quote(name)}/history?{urlencode(asked)}"
