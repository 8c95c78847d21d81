"""Advice on the zone and on HMAX as sentences."""

from collections.abc import Sequence

from service.advice.statements import FileChange, Statement
from service.advice.zone_size import LEAST_BATCHES, ZoneCost, ZoneSize
from service.missions.mission import Band, Mission

WIDER, NARROWER = 1.05, 0.5
"""Times the width of the widest field of view; as `mission_check` judges a file."""


def zone_statements(mission: Mission, size: ZoneSize, costs: Sequence[ZoneCost]) -> list[Statement]:
    """The statements on CCAP or WBAND, by recorded a priori errors, and on HMAX.

    `costs` are those of `size.sizes_deg`.
    """
    return [_size_statement(mission, size, costs), _hmax_statement(mission, size)]


def _size_statement(mission: Mission, size: ZoneSize, costs: Sequence[ZoneCost]) -> Statement:
    symbol = "WBAND" if isinstance(mission.zone, Band) else "CCAP"
    start = f"{symbol} ({size.setting})"
    room = (
        f"{size.size_deg:g}° leaves room for an a priori error of {size.margin_deg:.2f}° about the "
        f"field of view of {size.field_of_view_deg:g}°"
    )
    errors = size.errors
    if errors is None or size.covering_deg is None:
        return Statement(
            "wait",
            f"{start}: {room}. At least {LEAST_BATCHES} batches with an a priori attitude and an "
            "attitude are needed to say whether that is enough.",
        )
    seen = (
        f"in the latest {errors.batches} batches the error was usually no more than "
        f"{errors.usual_deg:.2f}°"
    )
    gross = ""
    if errors.gross:
        gross = (
            f" Larger errors ({errors.gross}, up to {errors.largest_deg:.2f}°) are faults of their "
            "source, which no zone mends."
        )
    change = f"{size.setting} = {size.covering_deg:g}"
    line = f"{size.setting.removeprefix('zone.')} = {size.covering_deg:g}"
    lines = (FileChange("zone", None, f"{line:<32} # {symbol}, was {size.size_deg:g}"),)
    if size.verdict == "fits":
        return Statement("keep", f"{start} fits: {room}, and {seen}.{gross}")
    if size.verdict == "too_small":
        return Statement(
            "widen",
            f"{start} is too small: {room}, and {seen}; in {errors.beyond} of them it was "
            f"more than there is room for. Set {change}, or correct the a priori attitude."
            f"{_cost(size, costs)}{gross}",
            lines,
        )
    return Statement(
        "tighten",
        f"{start} is larger than needed: {room}, and {seen}. {change} covers that and a fifth "
        f"more.{_cost(size, costs)}{gross}",
        lines,
    )


def _cost(size: ZoneSize, costs: Sequence[ZoneCost]) -> str:
    pairs = {each.size_deg: each.pairs for each in costs}
    if size.covering_deg is None or len(pairs) < 2:
        return ""
    then, now = pairs[size.covering_deg], pairs[size.size_deg]
    return f" The richest zone of the sky then holds {then:,} pairs (NTOT) instead of {now:,}."


def _hmax_statement(mission: Mission, size: ZoneSize) -> Statement:
    limit_deg = mission.tolerances.pair_separation_max_deg
    wide_deg = 2.0 * size.field_of_view_deg
    start = "HMAX (pair_separation_max_deg)"
    line = f"{f'pair_separation_max_deg = {wide_deg:g}':<32} # HMAX, was {limit_deg:g}"
    lines = (FileChange("tolerances", None, line),)
    if limit_deg > WIDER * wide_deg:
        return Statement(
            "tighten",
            f"{start} is larger than needed: no two stars of a field of view of {wide_deg:g}° are "
            f"{limit_deg:g}° apart. {wide_deg:g} makes the pair index smaller and loses nothing.",
            lines,
        )
    if limit_deg < NARROWER * wide_deg:
        return Statement(
            "widen",
            f"{start} is small: {limit_deg:g}° leaves out most pairs of a field of view of "
            f"{wide_deg:g}°. {wide_deg:g} uses all of them.",
            lines,
        )
    return Statement(
        "keep", f"{start} fits: {limit_deg:g}° beside a field of view of {wide_deg:g}°."
    )
