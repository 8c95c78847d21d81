"""Lost in space against other solvers: the same scenes in the same run, every answer checked.

    python -m benchmarks.validation.lost_in_space --scenes 40000 --seed 7   a table
    python -m benchmarks.validation.lost_in_space --scenes 40000 --write    docs/lost-in-space.md

The others come into an environment of their own:

    pip install '.[peers]' && pip install --no-deps cedar-solve

Right: an attitude whose boresight is within 0.1 deg and whose total rotation is
within 1 deg of the truth; wrong: any other; none: no answer.  `--scenes` is the
number at one pixel; other conditions take a stated share of it, and slow solvers
the first scenes only.  Times are of the process's own clock around each call
from Python.  Solvers take turns in blocks of scenes, each as it would be run on a
stream of pictures: made ready before the block, warmed by one scene that is not
timed, judged after it; and another goes first in every block.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.bounds import faults_of
from benchmarks.record import ROOT
from benchmarks.validation.lost_in_space.conditions import CONDITIONS
from benchmarks.validation.lost_in_space.document import bounds_of, document, shown_rows
from benchmarks.validation.lost_in_space.measure import TURN, measured

DEFAULT_SEED = 19941026
TARGET = ROOT / "docs" / "lost-in-space.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command that measures and writes; returns 1 if a figure is out of bounds."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation.lost_in_space",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    every = ", ".join(CONDITIONS).replace("%", "%%")
    parser.add_argument("names", nargs="*", metavar="condition", help=every)
    parser.add_argument("--scenes", type=int, default=2000, help="at one pixel; default 2000")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the rows")
    parser.add_argument("--write", action="store_true", help=f"write docs/{TARGET.name}")
    parser.add_argument("--alone", action="store_true", help="without the other solvers")
    asked = parser.parse_args(arguments)
    if unknown := set(asked.names) - set(CONDITIONS):
        parser.error(f"no such condition: {', '.join(sorted(unknown))}")
    if asked.scenes < 1:
        parser.error("--scenes must be at least 1")
    rows = measured(asked.names or list(CONDITIONS), asked.scenes, asked.seed, not asked.alone)
    print(shown_rows(rows))
    if asked.json is not None:
        text = json.dumps([asdict(row) for row in rows], indent=1)
        asked.json.write_text(text + "\n", encoding="utf-8")
    if asked.write:
        text, pictures = document(rows, asked.scenes, asked.seed, TURN)
        TARGET.write_text(text, encoding="utf-8")
        for name, svg in pictures.items():
            (TARGET.parent / "plots" / name).write_text(svg, encoding="utf-8")
        print(f"wrote {TARGET.name} and {len(pictures)} plots")
    faults = faults_of(bounds_of(rows))
    for fault in faults:
        print(f"! {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
