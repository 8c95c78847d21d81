"""Sections of docs/verification.md: what a benchmark writes, and how the page keeps it.

A section stands between two comments.  The first tells its seed, its size and
whether it is within its bounds, so that one section can be remade and the
others kept as they are:

    <!-- section covariance; seed 7; full size; within bounds -->
    ...
    <!-- end of covariance -->
"""

import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.report import shown
from service.simulate.drawing import Folder, pictures_in

_KEPT = re.compile(
    r"<!-- section (?P<name>[\w-]+); seed (?P<seed>\d+); (?P<size>[^;]+); (?P<state>[^;]+) -->\n"
    r"(?P<text>.*?)\n<!-- end of (?P=name) -->\n",
    re.DOTALL,
)
_WITHIN, _OUT = "within bounds", "out of bounds"


@dataclass(frozen=True)
class Written:
    """What a section says, in Markdown without its heading, and whether it is within bounds.

    `pictures` are SVG texts by file name; the page finds them in its folder `plots`.
    `pages` are other Markdown pages by file name, which stand beside it.
    """

    text: str
    passed: bool
    pictures: Mapping[str, str] = field(default_factory=dict)
    pages: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """A section of the page.  `write` is given whether samples are small, and the seed."""

    title: str
    write: Callable[[bool, int], Written]


def pictures_of(salt: str, paint: Callable[[Folder], None]) -> dict[str, str]:
    """What `paint` draws and saves, as SVG texts by file name."""
    with tempfile.TemporaryDirectory() as folder, pictures_in(Path(folder), salt) as pictures:
        paint(pictures)
        return {path.name: path.read_text(encoding="utf-8") for path in pictures.written}


def framed(name: str, title: str, written: Written, quick: bool, seed: int) -> str:
    """A section made anew, between its comments."""
    size = "small samples" if quick else "full size"
    state = _WITHIN if written.passed else _OUT
    doubt = "" if written.passed else "**Some of these figures are out of bounds.**\n\n"
    return (
        f"<!-- section {name}; seed {seed}; {size}; {state} -->\n"
        f"## {title}\n\n"
        f"{written.text.strip()}\n\n"
        f"{doubt}"
        f"Seed {seed}, {size}; again: `python -m benchmarks.verification --only {name}`.\n"
        f"<!-- end of {name} -->\n"
    )


def kept(page: str) -> dict[str, str]:
    """The sections of a page by name, each between its comments."""
    return {match["name"]: match[0] for match in _KEPT.finditer(page)}


def out_of_bounds(sections: Mapping[str, str]) -> list[str]:
    """Names of the sections that say so of themselves."""
    return [
        name
        for name, text in sections.items()
        if (match := _KEPT.match(text)) and match["state"] == _OUT
    ]


def table(head: Sequence[str], rows: Iterable[Sequence[object]], numbers: int = 0) -> str:
    """A Markdown table; the last `numbers` columns are set to the right."""
    rule = ["---"] * (len(head) - numbers) + ["---:"] * numbers
    lines = [head, rule, *([shown(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
