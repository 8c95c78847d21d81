"""Text for a terminal about reprocessed runs and their comparison."""

from service.contract.runs import RunComparison, RunTransition
from service.ingest.reprocess import ReprocessProgress

WIDTH = 96


WORDS = {"good": "attitudes good", "suspect": "attitudes suspect", "none": "no attitude"}


def progress_text(progress: ReprocessProgress) -> str:
    """Number of processed batches, as text for a terminal."""
    done = (
        f"{progress.recorded} recorded, {progress.before} there already, {progress.refused} refused"
    )
    return f"run {progress.run}, of {progress.total} batches:\n  {done}"


def comparison_text(compared: RunComparison) -> str:
    """Stars and attitudes of two compared runs, as text for a terminal."""
    stars, attitudes = compared.stars, compared.attitudes
    observed = stars.observed or 1
    lines = [
        "",
        f"{'':<26}{compared.run or 'every run':>16}{compared.other:>28}",
        f"{'batches in both':<26}{compared.batches:>16}{compared.batches:>28}",
        f"{'stars':<26}{stars.observed:>16}{stars.observed:>28}",
    ]
    for outcome in ("unique", "ambiguous", "unmatched"):
        before, after = (getattr(each, outcome) for each in (stars.before, stars.after))
        lines.append(f"  {outcome:<24}{_share(before, observed):>16}{_share(after, observed):>28}")
    for status, name in WORDS.items():
        before, after = (getattr(each, status) for each in (attitudes.before, attitudes.after))
        lines.append(f"{name:<26}{before:>16}{after:>28}")
    angle = attitudes.angle_arcsec
    if angle is not None:
        lines += ["", f"angle between the {attitudes.in_both} attitudes that both have:"]
        lines.append(
            f"  median {angle.median:.3f}″, 95 % within {angle.p95:.3f}″, at most {angle.max:.3f}″"
        )
    changed = [each for each in stars.transitions if each.is_change]
    if changed:
        lines += ["", "stars that came out otherwise:"]
        lines += [f"  {each.stars:>8}  {_words(each)}" for each in changed]
    elif compared.batches:
        lines += ["", "every star came out alike"]
    return "\n".join(lines)


def _share(count: int, observed: int) -> str:
    return f"{count} ({100 * count / observed:.2f} %)"


def _words(each: RunTransition) -> str:
    if each.before == each.after:
        return "unique in both, but not the same star"
    return f"{each.before} before, {each.after} after"
