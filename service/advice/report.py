"""Advice as plain values for JSON, and as text for a terminal."""

import math
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

from service.advice.advice import Advice
from service.advice.intervals import Interval
from service.advice.statements import (
    Statement,
    alignment_statement,
    group_statements,
    magnitude_statement,
    noise_statement,
    tolerance_statement,
)
from service.advice.trials import Trial

Row = dict[str, Any]
WIDTH = 96


def advice_record(advice: Advice) -> Row:
    """The advice ready for JSON: findings with figures and words, the trials, the changes."""
    tolerances = [(each, tolerance_statement(each, advice)) for each in advice.tolerances]
    noise = [(each, noise_statement(each)) for each in advice.noise]
    magnitudes = [(each, magnitude_statement(each, advice)) for each in advice.magnitudes]
    alignment = [(each, alignment_statement(each)) for each in advice.alignment]
    statements = [each for pairs in (tolerances, noise, magnitudes, alignment) for _, each in pairs]
    return {
        "mission": advice.mission.digest,
        "identifier": advice.mission.identifier,
        "batches_sampled": advice.sampled,
        "batches_identified": advice.identified,
        "batches_refused": advice.refused,
        "refusal": advice.refusal,
        "groups": [_words(each) for each in group_statements(advice)],
        "tolerances": [
            {
                "tolerance": each.tolerance.name,
                "symbol": each.symbol,
                "unit": each.tolerance.unit,
                "now": each.now,
                "verdict": each.verdict,
                "confidence": each.confidence,
                "differences": each.differences,
                "batches": each.batches,
                "needed": _interval(each.needed),
                "share_beyond": _interval(each.beyond),
                "recommended": each.recommended,
                **_words(words),
            }
            for each, words in tolerances
        ],
        "noise": [
            {
                "tracker": each.tracker,
                "now_arcsec": each.now_arcsec,
                "sigma_arcsec": _interval(each.sigma_arcsec),
                "batches": each.batches,
                "verdict": each.verdict,
                **_words(words),
            }
            for each, words in noise
        ],
        "magnitudes": [
            {
                "tracker": each.tracker,
                "pivot_mag": None if math.isnan(each.pivot_mag) else each.pivot_mag,
                "offset_mag": _interval(each.offset_mag),
                "scale": _interval(each.scale),
                "now_sigma_mag": each.now_sigma_mag,
                "scatter_mag": _interval(each.scatter_mag),
                "stars": each.stars,
                "verdict": each.verdict,
                "scatter_verdict": each.scatter_verdict,
                **_words(words),
            }
            for each, words in magnitudes
        ],
        "alignment": [
            {
                "tracker": each.tracker,
                "reference": each.reference,
                "rotation_arcsec": each.rotation_arcsec
                and [_interval(part) for part in each.rotation_arcsec],
                "axes_body": each.axes_body,
                "batches": each.batches,
                "verdict": each.verdict,
                **_words(words),
            }
            for each, words in alignment
        ],
        "tried": [_trial_record(each) for each in advice.trials],
        "changes": _changes(statements),
    }


def _changes(statements: Iterable[Statement]) -> list[Row]:
    """The lines to write, a key of a table once: trackers may share one."""
    lines: dict[tuple[str, str | None, str], Row] = {}
    for change in (change for each in statements for change in each.changes):
        key = change.table, change.tracker, change.line.partition(" = ")[0]
        lines.setdefault(
            key, {"table": change.table, "tracker": change.tracker, "line": change.line}
        )
    return list(lines.values())


def _words(statement: Statement) -> Row:
    return {"action": statement.action, "text": statement.text}


def _interval(found: Interval | None) -> Row | None:
    """The bounds, null where the sample does not bound it."""
    if found is None:
        return None
    parts = {"value": found.value, "low": found.low, "high": found.high}
    return {name: part if math.isfinite(part) else None for name, part in parts.items()}


def _trial_record(each: Trial) -> Row:
    return {
        "name": each.variant.name,
        "identifier": each.variant.identifier,
        "tolerances": dict(each.variant.tolerances),
        "batches": each.batches,
        "observed": each.observed,
        "unique": each.unique,
        "ambiguous": each.ambiguous,
        "unmatched": each.unmatched,
        "named_otherwise": each.other_star,
        "change_points": _interval(each.change),
    }


# ---- for a terminal --------------------------------------------------------------------------


def advice_text(row: Mapping[str, Any]) -> str:
    """The advice for people: sentences, a table of trials, the lines to change."""
    lines = [*_heading(row), ""]
    for title, kind in (
        ("Groups of stars", "groups"),
        ("Tolerances", "tolerances"),
        ("Noise", "noise"),
        ("Magnitudes", "magnitudes"),
        ("Alignment", "alignment"),
    ):
        if row[kind]:
            lines += [title, *_sentences(row[kind]), ""]
    lines += [*_table(row["tried"]), "", *changes_text(row)]
    return "\n".join(lines)


def _heading(row: Mapping[str, Any]) -> list[str]:
    span = f"{row['first']} to {row['last']}" if row["first"] else "no batches"
    lines = [f"Advice for {row['spacecraft']}, run {row['run']}: {span}"]
    sampled = f"{row['batches_sampled']} of {row['batches_in_range']} batches were examined"
    if row["batches_refused"]:
        sampled += f"; {row['batches_refused']} could not be processed again: {row['refusal']}"
    return [*lines, *textwrap.wrap(sampled + ".", WIDTH)]


def _sentences(findings: Iterable[Mapping[str, Any]]) -> list[str]:
    marks = {"keep": "  ok  ", "wait": "  ?   "}
    return [
        line
        for each in findings
        for line in textwrap.wrap(
            each["text"],
            WIDTH,
            initial_indent=marks.get(each["action"], "  !!  "),
            subsequent_indent="      ",
        )
    ]


def _table(tried: Iterable[Mapping[str, Any]]) -> list[str]:
    wide = max(28, *(len(each["name"]) for each in tried))
    heads = "  ".join(("batches", "stars", "ambig. %", "unmat. %", "other"))
    lines = [
        "Outcomes of the stars with other settings",
        f"  {'':<{wide}}  {'':<8}  {heads}",
    ]
    for each in tried:
        observed = each["observed"] or 1
        lines.append(
            f"  {each['name']:<{wide}}  {each['identifier']:<8}  {each['batches']:>7}"
            f"  {each['observed']:>5}  {100 * each['ambiguous'] / observed:>8.2f}"
            f"  {100 * each['unmatched'] / observed:>8.2f}  {each['named_otherwise']:>5}"
        )
    return [*lines, "  other: stars that verified identification names differently"]


def changes_text(row: Mapping[str, Any]) -> list[str]:
    """The lines for the mission file, under the tables that they belong to."""
    if not row["changes"]:
        return [no_changes_text(row)]
    lines = [f"To change in the mission file of {row['spacecraft']}:"]
    place = None
    for each in sorted(row["changes"], key=lambda c: (c["table"], c["tracker"] or "")):
        if (each["table"], each["tracker"]) != place:
            place = each["table"], each["tracker"]
            lines.append(
                f"  [[trackers]]   of {each['tracker']}"
                if each["tracker"]
                else f"  [{each['table']}]"
            )
        lines.append(f"  {each['line']}")
    return lines


def no_changes_text(row: Mapping[str, Any]) -> str:
    """The text shown when no line of the mission file should change."""
    findings = (row[kind] for kind in ("tolerances", "noise", "magnitudes", "alignment"))
    actions = {each["action"] for found in findings for each in found}
    if actions - {"keep", "wait"}:
        return "No line of the mission file corrects these findings: each sentence says what to do."
    if "wait" in actions:
        return "The batches so far give no reason to change the mission file."
    return "Nothing in the mission file needs to change."
