"""Two runs side by side, for a terminal."""

from collections.abc import Mapping
from typing import Any

from service.ingest.reprocess import Progress


def comparison_text(progress: Progress, compared: Mapping[str, Any]) -> str:
    """What was run again, and what became of the stars and attitudes in either run."""
    stars, attitudes = compared["stars"], compared["attitudes"]
    observed = stars["observed"] or 1
    done = (
        f"{progress.recorded} recorded, {progress.before} there already, {progress.refused} refused"
    )
    lines = [
        f"run {progress.run}, of {progress.total} batches:",
        f"  {done}",
        "",
        f"{'':<26}{compared['run']:>16}{compared['other']:>28}",
        f"{'batches in both':<26}{compared['batches']:>16}{compared['batches']:>28}",
        f"{'stars':<26}{stars['observed']:>16}{stars['observed']:>28}",
    ]
    for outcome in ("unique", "ambiguous", "unmatched"):
        before, after = stars["before"][outcome], stars["after"][outcome]
        lines.append(f"  {outcome:<24}{_share(before, observed):>16}{_share(after, observed):>28}")
    for state in ("good", "suspect", "none"):
        name = f"attitudes {state}" if state != "none" else "no attitude"
        lines.append(f"{name:<26}{attitudes['before'][state]:>16}{attitudes['after'][state]:>28}")
    angle = attitudes["angle_arcsec"]
    if angle is not None:
        lines += ["", f"angle between the {attitudes['in_both']} attitudes that both have:"]
        lines.append(
            f"  median {angle['median']:.3f}″, 95 % within {angle['p95']:.3f}″, "
            f"at most {angle['max']:.3f}″"
        )
    changed = [each for each in stars["transitions"] if not _is_alike(each)]
    if changed:
        lines += ["", "stars that came out otherwise:"]
        lines += [f"  {each['stars']:>8}  {_words(each)}" for each in changed]
    elif compared["batches"]:
        lines += ["", "every star came out alike"]
    return "\n".join(lines)


def _share(count: int, observed: int) -> str:
    return f"{count} ({100 * count / observed:.2f} %)"


def _is_alike(each: Mapping[str, Any]) -> bool:
    named_alike = each["same_star"] or each["before"] != "unique"
    return bool(each["before"] == each["after"] and named_alike)


def _words(each: Mapping[str, Any]) -> str:
    if each["before"] == each["after"]:
        return "unique in both, but not the same star"
    return f"{each['before']} before, {each['after']} after"
