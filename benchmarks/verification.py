"""Writes docs/verification.md: what was verified, how, and the figures of this machine.

    python -m benchmarks.verification                        every section, an hour or two
    python -m benchmarks.verification --quick                small samples, to see that it works
    python -m benchmarks.verification --only sky,covariance  these anew, the others as they are
    python -m benchmarks.verification --check                measure nothing: which are stale?

A section is a module of `benchmarks.validation` with its `SECTION`, listed in `SECTIONS`.
The exit code is 1 where the page has a section out of its bounds.

`--check` names the sections of docs/verification.md and of docs/performance.md
whose source files have changed since they were measured, and exits with 1 if there
are any.  It belongs before a release: a change of the code need not wait for hours
of measurement, so `make check` looks only whether every section has its record and
its bounds.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.record import ROOT, record_of
from benchmarks.sections import Section, framed, has_record, kept, out_of_bounds, stale
from benchmarks.speed import performance
from benchmarks.validation import (
    aberration,
    attitude_against_svd,
    calibration,
    centroids,
    consistency,
    covariance,
    deep_fields,
    imaging_claims,
    paper_runs,
    plain_reference,
    ptp,
    spurious,
    two_groups,
    whole_sky,
    zone_counts,
)
from benchmarks.validation.lost_in_space import measure as lost_in_space
from service import __version__

SECTIONS: Mapping[str, Section] = {
    "sky": zone_counts.SECTION,
    "identification": plain_reference.SECTION,
    "paper": paper_runs.SECTION,
    "spurious": spurious.SECTION,
    "two_groups": two_groups.SECTION,
    "calibration": calibration.SECTION,
    "whole_sky": whole_sky.SECTION,
    "deep_fields": deep_fields.SECTION,
    "lost_in_space": lost_in_space.SECTION,
    "attitude": attitude_against_svd.SECTION,
    "covariance": covariance.SECTION,
    "consistency": consistency.SECTION,
    "aberration": aberration.SECTION,
    "imaging": imaging_claims.SECTION,
    "centroids": centroids.SECTION,
    "ptp": ptp.SECTION,
}
"""Sections in the order of the page."""

TARGET = ROOT / "docs" / "verification.md"
DEFAULT_SEED = 19941026


def page(sections: Mapping[str, str]) -> str:
    """Page of the given sections, in the order of `SECTIONS`."""
    doubtful = out_of_bounds(sections)
    verdict = (
        f"**Out of bounds: {', '.join(doubtful)}.**"
        if doubtful
        else "Everything is within its bounds."
    )
    unrecorded = [name for name, text in sections.items() if not has_record(text)]
    older = (
        f"""
Measured before records and bounds were kept, and to be made anew: {", ".join(unrecorded)}.
"""
        if unrecorded
        else ""
    )
    here = [name for name in SECTIONS if name in sections]
    body = "\n".join(sections[name] for name in here)
    return f"""# Verification

Written by `python -m benchmarks.verification`, for engineers who decide how far to trust the
answers: each method, compared with independent results. Its figures are not edited by hand.
Version {__version__}. {verdict}

Every section is also a test: `make test` runs the same comparisons on smaller samples. Each ends
with its bounds, beside a table with their number alone, and with the commit, the library versions
and the seed that it was measured with. `python -m benchmarks --all` prints every bound, and `make
stale` names the sections whose source files have changed since their commit. Where a figure is a
count of random events, its bound is one that chance alone passes once in 10,000 times.
{older}
{body}"""


def remake(names: Sequence[str], quick: bool, seed: int, output: Path) -> bool:
    """Make the named sections anew, keep the others; true if all are within bounds."""
    sections: dict[str, str] = {}
    for name in names:
        # Before the measurement, which takes minutes: the code may be edited meanwhile.
        record = record_of(SECTIONS[name].all_sources)
        written = SECTIONS[name].write(quick, seed)
        # Read only now: writing a section takes minutes, and another may have been made meanwhile.
        here = kept(output.read_text(encoding="utf-8")) if output.exists() else {}
        sections = {name: text for name, text in here.items() if name in SECTIONS}
        sections[name] = framed(name, SECTIONS[name].title, written, quick, seed, record)
        output.parent.mkdir(parents=True, exist_ok=True)
        if written.pictures:
            plots = output.parent / "plots"
            plots.mkdir(parents=True, exist_ok=True)
            for file, picture in written.pictures.items():
                (plots / file).write_text(picture, encoding="utf-8")
        for file, beside in written.pages.items():
            (output.parent / file).write_text(beside, encoding="utf-8")
        # Write after each section, so that an interrupted run keeps its results.
        output.write_text(page(sections), encoding="utf-8")
    return not out_of_bounds(sections)


def check(output: Path) -> int:
    """Print the stale sections of the page and of docs/performance.md; 1 if there are any."""
    page = kept(output.read_text(encoding="utf-8")) if output.exists() else {}
    found = [f"{output.name}: {each}" for each in stale(page, SECTIONS)]
    found += [f"{performance.TARGET.name}: {each}" for each in performance.stale()]
    for each in found:
        print(each)
    print(f"{len(found)} stale sections" if found else "no section is stale")
    return 1 if found else 0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.verification",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="small samples")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--check", action="store_true", help="name the stale sections")
    parser.add_argument("--output", type=Path, default=TARGET)
    parser.add_argument(
        "--only",
        metavar="NAME[,NAME]",
        default=",".join(SECTIONS),
        help=f"make only these sections anew: {', '.join(SECTIONS)}",
    )
    asked = parser.parse_args(arguments)
    names = asked.only.split(",")
    if unknown := [name for name in names if name not in SECTIONS]:
        parser.error(f"no such section: {', '.join(unknown)}")
    if asked.check:
        return check(asked.output)
    passed = remake(names, asked.quick, asked.seed, asked.output)
    print(f"wrote {asked.output}{'' if passed else ': some figures are out of bounds'}")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
