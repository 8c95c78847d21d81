"""Advice as sentences, with the lines of the mission file to change."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from service.features.advice.advice import ALL_RECOMMENDED, PRESENT, Findings, VariantOutcome
from service.features.advice.tolerances import (
    KEPT,
    LEAST_BATCHES,
    LEAST_DIFFERENCES,
    ToleranceFinding,
)
from service.features.advice.trackers import AlignmentFinding, MagnitudeFinding, NoiseFinding
from service.features.advice.zone_size import LEAST_BATCHES as LEAST_BATCHES_OF_ZONES
from service.features.advice.zone_size import ZoneCost, ZoneSize
from service.intervals import Interval
from service.missions.mission import Mission

Action = Literal["widen", "tighten", "keep", "correct", "wait"]
_APRIORI = ("cross_product_deg", "pole_difference_deg", "pole_angle_deg")
"""Tolerances that bound errors of the a priori attitude, not of the tracker."""
MIRRORED_BY_CHANCE, CERTAIN = 0.02, 0.001
"""Share of batches whose stars fit a mirror by chance, and the greatest chance that is none."""


@dataclass(frozen=True)
class FileChange:
    """A line to write into the mission file: its table, its tracker if any, and the text."""

    table: Literal["zone", "tolerances", "catalog", "trackers", "gyro"]
    tracker: str | None
    line: str


@dataclass(frozen=True)
class Statement:
    """Recommended action for a setting, a sentence that explains it, and the lines that carry it
    out.

    A line is meant to be written unchanged; there is none where the sentence recommends keeping the
    setting or correcting something else first.
    """

    action: Action
    text: str
    changes: tuple[FileChange, ...] = ()


def _by_chance(mirrored: int, sampled: int) -> float:
    """Probability of this or a larger number of mirrored batches by chance (binomial).

    scipy.special has it, but to import that takes a tenth of a second of each start.
    """
    log_p, log_q = math.log(MIRRORED_BY_CHANCE), math.log1p(-MIRRORED_BY_CHANCE)
    ways = (
        math.lgamma(sampled + 1) - math.lgamma(k + 1) - math.lgamma(sampled - k + 1)
        for k in range(mirrored)
    )
    fewer = (math.exp(w + k * log_p + (sampled - k) * log_q) for k, w in enumerate(ways))
    return 1.0 - math.fsum(fewer)


def group_statements(advice: Findings) -> list[Statement]:
    """Sentences on batches with two groups of stars, and on mirrored batches."""
    statements = []
    if advice.with_rival:
        statements.append(
            Statement(
                "correct",
                f"In {advice.with_rival} of {advice.sampled} batches two groups of stars have each "
                "an attitude of their own, and the attitude is suspect: look for reflections in "
                "the tracker, or for a slew while the stars of a batch were observed.",
            )
        )
    if advice.mirrored and _by_chance(advice.mirrored, advice.sampled) < CERTAIN:
        statements.append(
            Statement(
                "correct",
                f"In {advice.mirrored} of {advice.sampled} batches the stars fit better in a "
                "mirror: look whether an axis of the tracker has the wrong sign, or two are "
                "exchanged.",
            )
        )
    return statements


def tolerance_statement(finding: ToleranceFinding, advice: Findings) -> Statement:
    """Sentence and action for one tolerance."""
    name, unit = finding.tolerance.name, finding.tolerance.unit
    now = _quantity(finding.now, unit)
    start = name
    if finding.verdict == "not_used":
        return Statement("keep", f"{start}: its test is off, so it has no effect.")
    if not advice.uses_voting:
        text = f"{start} is not used by the identifier {advice.mission.identifier}: no effect."
        if finding.recommended is not None:
            text += f" By votes it should be {finding.recommended:g}."
        return Statement("keep", text)
    if finding.verdict == "no_verdict" or finding.needed is None or finding.beyond is None:
        return Statement(
            "wait",
            f"{start}: too little data to judge it: {finding.differences} differences of "
            f"{finding.batches} batches. At least {LEAST_BATCHES} batches and "
            f"{LEAST_DIFFERENCES} differences are needed, more where they scatter widely.",
        )
    needed = _with_bounds(finding.needed, unit)
    kept = f"{100 * KEPT:.0f} % of the {finding.tolerance.what} agree with the catalog within"
    if finding.verdict == "fits":
        times = finding.now / finding.needed.value if finding.needed.value else math.inf
        return Statement(
            "keep", f"{start} fits: {kept} {needed}, and {now} leaves {times:.1f} times that."
        )
    present, with_it = _present_and_recommended(finding, advice.trials)
    effect = _effect(present, with_it)
    if finding.verdict == "too_tight":
        beyond = _percent_with_bounds(finding.beyond)
        loses = finding.tolerance.loses.format(share=beyond, what=finding.tolerance.what)
        text = f"{start} is too tight: {now} {loses}; {kept} {needed}. {effect}"
        if name == "magnitude_mag" and any(m.verdict == "off" for m in advice.magnitudes):
            return Statement(
                "wait",
                text + " Part of it is the offset of the magnitudes: correct that first, "
                "then ask again.",
            )
        if name == "separation_deg" and any(n.before_arcsec or n.worst for n in advice.noise):
            return Statement(
                "wait",
                text + " The noise changed meanwhile: correct that first, then ask again for a "
                "period in which it is constant.",
            )
        return _change_statement("widen", text, finding)
    text = f"{start} is wide: {kept} {needed}, and {now} is far more than that. {effect}"
    if not _gains(present, with_it):
        return Statement("keep", text + " A smaller value gains nothing certain: keep it.")
    if name in _APRIORI:
        text += " That holds while the a priori attitude stays as good as in this sample."
    return _change_statement("tighten", text, finding)


def _change_statement(action: Action, text: str, finding: ToleranceFinding) -> Statement:
    line = f"{finding.tolerance.name} = {finding.recommended:g}"
    change = FileChange("tolerances", None, f"{line:<32} # was {finding.now:g}")
    return Statement(action, text, (change,))


def _present_and_recommended(
    finding: ToleranceFinding, trials: Sequence[VariantOutcome]
) -> tuple[VariantOutcome | None, VariantOutcome | None]:
    """Trials by votes with the present settings, and with only this tolerance as recommended."""
    present = next((t for t in trials if t.variant.name == PRESENT), None)
    alone = {finding.tolerance.name: finding.recommended}
    found = (
        t
        for t in trials
        if dict(t.variant.tolerances) == alone and t.variant.name != ALL_RECOMMENDED
    )
    return present, next(found, None)


def _effect(present: VariantOutcome | None, with_it: VariantOutcome | None) -> str:
    if present is None or with_it is None or with_it.change is None or not with_it.observed:
        return "There was no time to try another value."
    change = with_it.change
    value = next(iter(with_it.variant.tolerances.values()))
    return (
        f"With {value:g} the votes would have left {with_it.not_unique_percent:.2f} % of "
        f"{with_it.observed} stars ambiguous or unmatched instead of "
        f"{present.not_unique_percent:.2f} % (a change of {change.low:+.2f} to "
        f"{change.high:+.2f} percentage points)."
    )


def _gains(present: VariantOutcome | None, with_it: VariantOutcome | None) -> bool:
    if present is None or with_it is None or with_it.change is None:
        return False
    return with_it.change.high < 0.0 and with_it.other_star <= present.other_star


def noise_statement(finding: NoiseFinding) -> Statement:
    """Sentence and action for the noise of one tracker."""
    start = f"Noise of {finding.tracker}"
    if finding.sigma_arcsec is None:
        return Statement("wait", _too_few(start, finding.batches, "an attitude of its own"))
    found = f"{_with_bounds(finding.sigma_arcsec, 'arcsec')} per tangent axis"
    now = f"{finding.now_arcsec:.2f}″"
    if finding.before_arcsec is not None and finding.since is not None:
        found += (
            f" in the latest {finding.batches} batches, since {finding.since.text}, and was "
            f"{_with_bounds(finding.before_arcsec, 'arcsec')} before"
        )
    worst = _worst(finding)
    if finding.verdict == "fits":
        return Statement("keep", f"{start} is {found}: the mission's {now} fits.{worst}")
    ratio = finding.sigma_arcsec.value / finding.now_arcsec
    deviation = "too small" if finding.verdict == "too_small" else "too large"
    follows = (
        "attitudes are given as better than they are, and too many are called suspect"
        if finding.verdict == "too_small"
        else "attitudes are given as worse than they are, and misnamed stars pass unnoticed"
    )
    text = f"{start} is {found}, {ratio:.2f} times the mission's {now}, "
    text += f"which is {deviation}: {follows}."
    text += worst
    if finding.before_arcsec is not None and finding.since is not None:
        return Statement(
            "correct",
            f"{text} Look at the tracker first: no sigma holds while its noise changes. Once it "
            f"is steady, ask again of a stretch that begins after {finding.since.text}.",
        )
    line = f"sigma_arcsec = {finding.sigma_arcsec.value:.3g}"
    return Statement(
        "correct",
        text,
        (FileChange("trackers", finding.tracker, f"{line:<32} # was {finding.now_arcsec:g}"),),
    )


def _worst(finding: NoiseFinding) -> str:
    """Sentence on a period of more noise, empty without one."""
    if finding.worst is None:
        return ""
    worst = finding.worst
    ratio = worst.sigma_arcsec.value / finding.now_arcsec
    return (
        f" It was {_with_bounds(worst.sigma_arcsec, 'arcsec')}, {ratio:.2f} times the mission's, "
        f"in {worst.batches} batches from {worst.first.text} to {worst.last.text}: look for what "
        "happened to the tracker then."
    )


def magnitude_statement(finding: MagnitudeFinding, advice: Findings) -> Statement:
    """Sentence and action for the magnitudes of one tracker."""
    start = f"Magnitudes of {finding.tracker}"
    if finding.offset_mag is None or finding.scale is None or finding.scatter_mag is None:
        return Statement("wait", f"{start}: too little data to judge them: {finding.stars} stars.")
    offset, scale = finding.offset_mag, finding.scale
    text = (
        f"{start}: at {finding.pivot_mag:.1f} mag the tracker measures "
        f"{abs(offset.value):.3f} mag ({_bounds(offset, 3)}) "
        f"{'fainter' if offset.value > 0 else 'brighter'} than the catalog; a difference of one "
        f"magnitude is measured as {scale.value:.3f} ({scale.low:.3f} to {scale.high:.3f}); they "
        f"scatter by {finding.scatter_mag.value:.3f} mag "
        f"({_bounds(finding.scatter_mag, 3)})."
    )
    changes: list[FileChange] = []
    if finding.verdict == "off" and abs(offset.value) > finding.now_sigma_mag / 4:
        line = _color_line(advice.mission, finding, advice.magnitudes)
        if line is None:
            text += (
                " The trackers differ, and the catalog's magnitudes serve all of them: "
                "correct the offset before the magnitudes are sent."
            )
        else:
            changes.append(line)
            text += " Correct the offset in the catalog's magnitudes."
    if finding.verdict == "off" and not scale.holds(1.0):
        text += " No setting undoes a scale: look at the instrument's magnitude calibration."
    if finding.scatter_verdict in ("too_small", "too_large"):
        verdict = finding.scatter_verdict.replace("_", " ")
        text += f" The mission's sigma of {finding.now_sigma_mag:g} mag is {verdict}."
        line_text = f"magnitude_sigma_mag = {finding.scatter_mag.value:.2g}"
        changes.append(
            FileChange(
                "trackers",
                finding.tracker,
                f"{line_text:<32} # SIGMAG, was {finding.now_sigma_mag:g}",
            )
        )
    if not changes and finding.verdict == "fits":
        text += " That fits."
    return Statement(
        "correct" if changes or finding.verdict == "off" else "keep", text, tuple(changes)
    )


def _color_line(
    mission: Mission, finding: MagnitudeFinding, all_of_them: Sequence[MagnitudeFinding]
) -> FileChange | None:
    """New line of the colour polynomial, its constant corrected; None where trackers disagree."""
    for other in all_of_them:
        if other is finding or other.offset_mag is None or finding.offset_mag is None:
            continue
        if abs(other.offset_mag.value - finding.offset_mag.value) > finding.now_sigma_mag / 2:
            return None
    assert finding.offset_mag is not None
    constant, *rest = mission.catalog.color_polynomial_mag or (0.0,)
    terms = [round(constant + finding.offset_mag.value, 3), *rest]
    was = list(mission.catalog.color_polynomial_mag) or "V itself"
    return FileChange("catalog", None, f"{f'color_polynomial_mag = {terms}':<32} # was {was}")


def alignment_statement(finding: AlignmentFinding) -> Statement:
    """Sentence and action for the alignment of one tracker relative to another."""
    start = f"Alignment of {finding.tracker} with {finding.reference}"
    if finding.rotation_arcsec is None:
        return Statement("wait", _too_few(start, finding.batches, "an attitude of each"))
    parts = ", ".join(
        f"{axis} {each.value:+.1f}″ ({each.low:+.1f} to {each.high:+.1f})"
        for axis, each in zip("xyz", finding.rotation_arcsec, strict=True)
    )
    if finding.verdict == "fits":
        return Statement("keep", f"{start} fits: turned about the body axes by {parts}.")
    changes = tuple(
        FileChange(
            "trackers",
            finding.tracker,
            f"{name}_axis_body = [{', '.join(f'{part:.9f}' for part in axis)}]",
        )
        for name, axis in zip("xyz", finding.axes_body or (), strict=True)
    )
    return Statement(
        "correct",
        f"{start} is off: {finding.tracker} is turned about the body axes by {parts} from where "
        "the mission file has it.",
        changes,
    )


def _too_few(start: str, batches: int, what: str) -> str:
    return (
        f"{start}: too little data to judge it: {batches} batches give {what}, "
        f"{LEAST_BATCHES} are needed."
    )


def _quantity(value: float, unit: str) -> str:
    if unit == "deg":
        small = f" ({3600 * value:.1f}″)" if value < 0.1 else ""
        return f"{value:.4g}°{small}"
    return f"{value:.3g} mag" if unit == "mag" else f"{value:.2f}″"


def _with_bounds(found: Interval, unit: str) -> str:
    high = "unknown" if math.isinf(found.high) else _number(found.high, unit)
    return f"{_quantity(found.value, unit)} ({_number(found.low, unit)} to {high})"


def _number(value: float, unit: str) -> str:
    return f"{value:.2f}" if unit == "arcsec" else f"{value:.3g}"


def _bounds(found: Interval, decimals: int) -> str:
    # Bounds on the absolute value of the offset.
    low, high = found.low, found.high
    if found.value < 0:
        low, high = -high, -low
    return f"{low:.{decimals}f} to {high:.{decimals}f}"


def _percent_with_bounds(share: Interval) -> str:
    return f"{100 * share.value:.1f} % ({100 * share.low:.1f} to {100 * share.high:.1f})"


WIDER, NARROWER = 1.05, 0.5
"""Bounds on zone widths, in widths of the widest field of view; the same as in `mission_check`."""


def zone_statements(mission: Mission, size: ZoneSize, costs: Sequence[ZoneCost]) -> list[Statement]:
    """Sentences on zone size from recorded a priori errors, and on the separation of pairs.

    `costs` belong to `size.sizes_deg`.
    """
    return [_size_statement(size, costs), _pair_separation_statement(mission, size)]


def _size_statement(size: ZoneSize, costs: Sequence[ZoneCost]) -> Statement:
    start = size.setting
    room = (
        f"{size.size_deg:g}° leaves room for an a priori error of {size.margin_deg:.2f}° about the "
        f"field of view, whose radius is {size.view_radius_deg:g}°"
    )
    errors = size.errors
    if errors is None or size.covering_deg is None:
        return Statement(
            "wait",
            f"{start}: {room}. At least {LEAST_BATCHES_OF_ZONES} batches with an a priori attitude "
            "and an attitude are needed to say whether that is enough.",
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
    lines = (FileChange("zone", None, f"{line:<32} # was {size.size_deg:g}"),)
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
    return f" The richest zone of the sky then holds {then:,} pairs instead of {now:,}."


def _pair_separation_statement(mission: Mission, size: ZoneSize) -> Statement:
    limit_deg = mission.tolerances.pair_separation_max_deg
    wide_deg = 2.0 * size.view_radius_deg
    start = "pair_separation_max_deg"
    line = f"{f'pair_separation_max_deg = {wide_deg:g}':<32} # was {limit_deg:g}"
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
