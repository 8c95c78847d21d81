"""Writes docs/verification.md: what was verified, how, and the figures of this machine.

    python -m benchmarks.verification                        every section, an hour or two
    python -m benchmarks.verification --quick                small samples, to see that it works
    python -m benchmarks.verification --only sky,covariance  these anew, the others as they are

A section is a module of `benchmarks` with its `SECTION`, listed in `SECTIONS`.
The exit code is 1 where the page has a section out of its bounds.
"""

import argparse
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import (
    aberration,
    attitude_against_svd,
    calibration,
    centroids,
    covariance,
    imaging_claims,
    lost_in_space,
    paper_runs,
    plain_reference,
    ptp,
    spurious,
    verified_cost,
    whole_sky,
    zone_counts,
)
from benchmarks.sections import Section, framed, kept, out_of_bounds
from service import __version__

SECTIONS: Mapping[str, Section] = {
    "sky": zone_counts.SECTION,
    "identification": plain_reference.SECTION,
    "paper": paper_runs.SECTION,
    "spurious": spurious.SECTION,
    "calibration": calibration.SECTION,
    "whole_sky": whole_sky.SECTION,
    "verified_cost": verified_cost.SECTION,
    "lost_in_space": lost_in_space.SECTION,
    "attitude": attitude_against_svd.SECTION,
    "covariance": covariance.SECTION,
    "aberration": aberration.SECTION,
    "imaging": imaging_claims.SECTION,
    "centroids": centroids.SECTION,
    "ptp": ptp.SECTION,
}
"""In the order of the page."""

TARGET = Path(__file__).parent.parent / "docs" / "verification.md"
DEFAULT_SEED = 19941026


def page(sections: Mapping[str, str]) -> str:
    """The page of sections already framed, in the order of `SECTIONS`."""
    doubtful = out_of_bounds(sections)
    verdict = (
        f"**Out of bounds: {', '.join(doubtful)}.**"
        if doubtful
        else "Everything is within its bounds."
    )
    here = [name for name in SECTIONS if name in sections]
    contents = "\n".join(f"- {_link(SECTIONS[name].title)}" for name in here)
    body = "\n".join(sections[name] for name in here)
    return f"""# Verification

Written by `python -m benchmarks.verification`; its figures are not edited by hand.
Version {__version__}, Python {platform.python_version()}. {verdict}

Every section is also a test: `make test` runs the same comparisons on smaller samples, and
`python -m benchmarks --all` prints them.

{contents}

{body}"""


def _link(title: str) -> str:
    """A link to the heading of a section of the same page."""
    anchor = re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")
    return f"[{title}](#{anchor})"


def remake(names: Sequence[str], quick: bool, seed: int, output: Path) -> bool:
    """Make these sections of the page anew, keep the others; whether all are within bounds."""
    sections: dict[str, str] = {}
    for name in names:
        written = SECTIONS[name].write(quick, seed)
        # Read only now: writing a section takes minutes, and another may have been made meanwhile.
        here = kept(output.read_text(encoding="utf-8")) if output.exists() else {}
        sections = {name: text for name, text in here.items() if name in SECTIONS}
        sections[name] = framed(name, SECTIONS[name].title, written, quick, seed)
        output.parent.mkdir(parents=True, exist_ok=True)
        if written.pictures:
            plots = output.parent / "plots"
            plots.mkdir(parents=True, exist_ok=True)
            for file, picture in written.pictures.items():
                (plots / file).write_text(picture, encoding="utf-8")
        for file, beside in written.pages.items():
            (output.parent / file).write_text(beside, encoding="utf-8")
        # After each, so that a long run that is stopped has kept what it made.
        output.write_text(page(sections), encoding="utf-8")
    return not out_of_bounds(sections)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.verification",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="small samples")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
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
    passed = remake(names, asked.quick, asked.seed, asked.output)
    print(f"wrote {asked.output}{'' if passed else ': some figures are out of bounds'}")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
