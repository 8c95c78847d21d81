"""Advice as plain text for a terminal."""

import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

from service.features.advice.part import no_changes_text
from service.features.advice.records import Advice, Trial

WIDTH = 96


def advice_text(advice: Advice) -> str:
    """Format advice as lines of text for a terminal."""
    lines = [*_heading(advice), ""]
    sections: tuple[tuple[str, Sequence[Any]], ...] = (
        ("Groups of stars", advice.groups),
        ("Zone", advice.zone),
        ("Tolerances", advice.tolerances),
        ("Noise", advice.noise),
        ("Magnitudes", advice.magnitudes),
        ("Alignment", advice.alignment),
        ("Innovations", advice.innovations),
    )
    for title, findings in sections:
        if findings:
            lines += [title, *_sentences(findings), ""]
    lines += [*_table(advice.tried), "", *_changes(advice)]
    return "\n".join(lines)


def _heading(advice: Advice) -> list[str]:
    span = f"{advice.first} to {advice.last}" if advice.first else "no batches"
    lines = [f"Advice for {advice.spacecraft}, run {advice.run}: {span}"]
    sampled = f"{advice.batches_sampled} of {advice.batches_in_range} batches were examined"
    if advice.batches_refused:
        sampled += f"; {advice.batches_refused} could not be processed again: {advice.refusal}"
    return [*lines, *textwrap.wrap(sampled + ".", WIDTH)]


def _sentences(findings: Iterable[Any]) -> list[str]:
    """Findings as wrapped lines of text, each with a mark for its action."""
    marks = {"keep": "  ok  ", "wait": "  ?   "}
    return [
        line
        for each in findings
        for line in textwrap.wrap(
            each.text,
            WIDTH,
            initial_indent=marks.get(each.action, "  !!  "),
            subsequent_indent="      ",
        )
    ]


def _table(tried: Sequence[Trial]) -> list[str]:
    wide = max(28, *(len(each.name) for each in tried))
    heads = "  ".join(("batches", "stars", "ambig. %", "unmat. %", "other"))
    lines = [
        "Outcomes of the stars with other settings",
        f"  {'':<{wide}}  {'':<8}  {heads}",
    ]
    for each in tried:
        observed = each.observed or 1
        lines.append(
            f"  {each.name:<{wide}}  {each.identifier:<8}  {each.batches:>7}"
            f"  {each.observed:>5}  {100 * each.ambiguous / observed:>8.2f}"
            f"  {100 * each.unmatched / observed:>8.2f}  {each.named_otherwise:>5}"
        )
    return [*lines, "  other: stars that verified identification names differently"]


def _changes(advice: Advice) -> list[str]:
    """Lines to change in the mission file as text, grouped by table."""
    if not advice.changes:
        return [no_changes_text(advice)]
    heading = f"To change in the mission file of {advice.spacecraft}:"
    return [heading, textwrap.indent(mission_lines(advice), "  ")]


def mission_lines(advice: Advice) -> str:
    """Recommended lines of the mission file as TOML, grouped by table."""
    tables: dict[tuple[str, str], list[str]] = {}
    for each in advice.changes:
        tables.setdefault((each.table, each.tracker or ""), []).append(each.line)
    return "\n".join(
        "\n".join(
            [
                f'[[trackers]] # the table of this tracker\nname = "{tracker}"'
                if tracker
                else f"[{table}]",
                *lines,
            ]
        )
        for (table, tracker), lines in sorted(tables.items())
    )
