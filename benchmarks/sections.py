"""Sections of docs/verification.md: their content, and the comments that delimit them.

A section is enclosed by two comments.  The first has the seed, the sample size, the verdict on the
bounds and the measured code, so that one section can be remade and the others kept:

    <!-- section covariance; seed 7; full size; within bounds; commit ...; sources ...; ... -->
    ...
    <!-- end of covariance -->
"""

import inspect
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, takewhile
from pathlib import Path

from benchmarks.bounds import Bound, every, shown
from benchmarks.record import CORE, ROOT, SIMULATOR, Record, digest_of, read_record
from studies.documents import Folder, pictures_in

_KEPT = re.compile(
    r"<!-- section (?P<name>[\w-]+); seed (?P<seed>\d+); (?P<size>[^;]+); "
    r"(?P<state>[^;]+?)(?:; (?P<record>commit [^>]+))? -->\n"
    r"(?P<text>.*?)\n<!-- end of (?P=name) -->\n",
    re.DOTALL,
)
_WITHIN, _OUT = "within bounds", "out of bounds"
BOUNDS_HEAD = ("figure", "measured", "bound", "")
MOST_ROWS = 6
"""Number of bounds above which the table groups them by kind."""


@dataclass(frozen=True)
class Written:
    """Content of a section in Markdown without a heading, and the bounds of its figures.

    `pictures` are SVG texts by file name, for the page's folder `plots`.  `pages` are further
    Markdown pages by file name.
    """

    text: str
    bounds: Sequence[Bound]
    pictures: Mapping[str, str] = field(default_factory=dict)
    pages: Mapping[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """True if there are bounds, and all figures are within them."""
        return bool(self.bounds) and all(each.holds for each in self.bounds)


@dataclass(frozen=True)
class Section:
    """Section of the page.  `write` takes whether samples are small, and the seed.

    `sources` are the files and folders, besides the module of `write`, on which the figures depend.
    """

    title: str
    write: Callable[[bool, int], Written]
    sources: tuple[str, ...] = (*CORE, *SIMULATOR)

    @property
    def all_sources(self) -> tuple[str, ...]:
        """All sources of the figures, including the module that measures them."""
        module = Path(inspect.getfile(self.write)).resolve()
        own = (str(module.relative_to(ROOT)),) if module.is_relative_to(ROOT) else ()
        return (*self.sources, *own)


def pictures_of(salt: str, paint: Callable[[Folder], None]) -> dict[str, str]:
    """Pictures that `paint` draws and saves, as SVG texts by file name."""
    with tempfile.TemporaryDirectory() as folder, pictures_in(Path(folder), salt) as pictures:
        paint(pictures)
        return {path.name: path.read_text(encoding="utf-8") for path in pictures.written}


def framed(name: str, title: str, written: Written, quick: bool, seed: int, record: Record) -> str:
    """Text of a new section between its comments."""
    size = "small samples" if quick else "full size"
    state = _WITHIN if written.passed else _OUT
    doubt = "" if written.passed else "**Some of these figures are out of bounds.**\n\n"
    return (
        f"<!-- section {name}; seed {seed}; {size}; {state}; {record} -->\n"
        f"## {title}\n\n"
        f"{written.text.strip()}\n\n"
        f"{_bounds(written)}\n\n"
        f"{doubt}"
        f"{record.sentence} Seed {seed}, {size}; "
        f"again: `python -m benchmarks.verification --only {name}`.\n"
        f"<!-- end of {name} -->\n"
    )


def _bounds(written: Written) -> str:
    """Table of all bounds; next to a table of figures only their count and the broken ones."""
    if "\n| " not in written.text:
        return bounds_table(written.bounds)
    broken = [each for each in written.bounds if not each.holds]
    return bounds_table([*every("bounds", written.bounds)][:1] + broken)


def bounds_table(bounds: Iterable[Bound]) -> str:
    """Table of bounds, with marks on broken ones.

    With many bounds, all intact ones of a kind share a row: the text after the last colon of the
    name is the kind, and the row has the smallest and the greatest figure.
    """
    shown_bounds = list(bounds)
    rows = shown_bounds if len(shown_bounds) <= MOST_ROWS else _by_kind(shown_bounds)
    return table(
        BOUNDS_HEAD,
        [
            (row.figure, row.measured, row.asked, "holds" if row.holds else "**does not hold**")
            for row in rows
        ],
    )


def _by_kind(bounds: Iterable[Bound]) -> list[Bound]:
    kinds: dict[tuple[str, ...], list[Bound]] = {}
    for bound in bounds:
        kind = bound.figure.rpartition(": ")[2]
        key = (kind, bound.asked) if bound.holds else (bound.figure, bound.asked, "broken")
        kinds.setdefault(key, []).append(bound)
    rows = []
    for (kind, asked, *_), alike in kinds.items():
        if len(alike) == 1:
            rows.append(alike[0])
            continue
        least, most = min(alike, key=_leading), max(alike, key=_leading)
        ends = dict.fromkeys((least.measured, most.measured))
        rows.append(Bound(f"{kind} ({len(alike)} cases)", " … ".join(ends), asked, True))
    return rows


def _leading(bound: Bound) -> float:
    """Leading number of a measured figure; zero if there is none."""
    found = re.match(r"-?[\d,]*\.?\d+(e[+-]?\d+)?", bound.measured)
    return float(found[0].replace(",", "")) if found else 0.0


def bounds_shown(text: str) -> int:
    """Number of bounds shown by a section or a part of a page."""
    head = table(BOUNDS_HEAD, [])
    _, found, rest = text.partition(head + "\n")
    return len(rest.partition("\n\n")[0].splitlines()) if found else 0


def kept(page: str) -> dict[str, str]:
    """Sections of a page by name, each with its comments."""
    return {match["name"]: match[0] for match in _KEPT.finditer(page)}


def out_of_bounds(sections: Mapping[str, str]) -> list[str]:
    """Names of the sections marked as out of bounds."""
    return [
        name
        for name, text in sections.items()
        if (match := _KEPT.match(text)) and match["state"] == _OUT
    ]


def state_of(text: str) -> tuple[str, Record | None] | None:
    """State and record in the first comment of a section; None for other text."""
    match = _KEPT.match(text)
    return (match["state"], read_record(match["record"] or "")) if match else None


def has_record(text: str) -> bool:
    """True if a section has a record of the measured code."""
    state = state_of(text)
    return state is not None and state[1] is not None


def stale(sections: Mapping[str, str], known: Mapping[str, Section]) -> list[str]:
    """Sections measured with other code than the present one, or without a record."""
    old = []
    for name, section in known.items():
        state = state_of(sections.get(name, ""))
        record = state[1] if state else None
        if record is None:
            old.append(f"{name}: no record of the code that it was measured with")
        elif record.sources != digest_of(section.all_sources):
            old.append(f"{name}: measured at commit {record.commit}; its sources have changed")
    return old


def table(head: Sequence[str], rows: Iterable[Sequence[object]], numbers: int = 0) -> str:
    """Markdown table; the last `numbers` columns are aligned to the right."""
    rule = ["---"] * (len(head) - numbers) + ["---:"] * numbers
    lines = [head, rule, *([shown(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def tables_of(figures: Mapping[str, object]) -> str:
    """Tables of figures `label: kind` for labels with equal kinds, followed by all other figures.

    Consecutive other figures with equal values share a row.
    """
    kinds: dict[str, dict[str, object]] = {}
    for name, value in figures.items():
        label, _, kind = name.rpartition(": ")
        kinds.setdefault(label, {})[kind] = value
    alike: dict[tuple[str, ...], dict[str, dict[str, object]]] = {}
    for label, of in kinds.items():
        if label and len(of) > 1:
            alike.setdefault(tuple(of), {})[label] = of
    parts, shown_labels = [], set()
    for names, labels in alike.items():
        if len(labels) > 1:
            shown_labels |= set(labels)
            parts.append(_crossed(names, labels))
    others = [item for item in figures.items() if item[0].rpartition(": ")[0] not in shown_labels]
    rows = [
        (_joined([name for name, _ in same]), value)
        for value, same in groupby(others, key=lambda item: item[1])
    ]
    return "\n\n".join([*parts, table(("", "figure"), rows)])


def _crossed(names: Sequence[str], labels: Mapping[str, Mapping[str, object]]) -> str:
    if len(names) > len(labels):
        lines = [(name, *(of[name] for of in labels.values())) for name in names]
        return table(("", *labels), lines)
    return table(("", *names), [(label, *of.values()) for label, of in labels.items()])


def _joined(names: list[str]) -> str:
    """Joint name of several names: common beginning, differing words, common end."""
    split = [name.rpartition(": ") for name in names]
    labels = [label.split() or kind.split() for label, _, kind in split]
    same = takewhile(lambda words: len(set(words)) == 1, zip(*labels, strict=False))
    first = len(list(same))
    own = ", ".join(" ".join(words[first:]) for words in labels)
    end = f": {split[0][2]}" if split[0][0] else ""
    return " ".join([*labels[0][:first], own]).strip() + end if len(names) > 1 else names[0]
