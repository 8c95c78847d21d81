"""The measured parts of docs/cameras.md, each between two comments."""

from collections.abc import Mapping
from itertools import groupby, takewhile

from benchmarks.record import ROOT, record_of
from benchmarks.report import Report
from benchmarks.sections import table

DOCUMENT = ROOT / "docs" / "cameras.md"
SOURCES = (
    "catalogs/stars.npz",
    "service/acquire/camera_calibration.py",
    "service/acquire/picture.py",
    "service/identify/blind",
    "service/imaging/detection/points.py",
    "service/imaging/frames",
    "service/sky/whole_sky",
    "service/vectors.py",
    "tests/pictures/drawn.py",
    "benchmarks/validation/pictures",
)
"""What the answer to a picture depends on."""


def write_part(name: str, report: Report, options: str) -> None:
    """Put the figures of a run of a module of this folder between its comments."""
    module = f"benchmarks.validation.pictures.{name}"
    start, end = f"<!-- measured by {module} -->", f"<!-- end of {name} -->"
    figures = tables_of(report.figures)
    record = record_of(SOURCES)
    again = f"{record.sentence} Again:\n`python -m {module} {options}`."
    part = f"{start}\n\n{figures}\n\n{again}\n{end}"
    before, _, rest = DOCUMENT.read_text(encoding="utf-8").partition(start)
    DOCUMENT.write_text(before + part + rest.partition(end)[2], encoding="utf-8")


def tables_of(figures: Mapping[str, object]) -> str:
    """Figures `label: kind` that have several kinds as columns, then the others as rows.

    Others that follow each other with the same value share a row.
    """
    kinds: dict[str, dict[str, object]] = {}
    for name, value in figures.items():
        label, _, kind = name.rpartition(": ")
        kinds.setdefault(label, {})[kind] = value
    wide = {label: of for label, of in kinds.items() if label and len(of) > 1}
    parts = []
    if wide:
        head = dict.fromkeys(kind for of in wide.values() for kind in of)
        rows = [(label, *(of.get(kind, "") for kind in head)) for label, of in wide.items()]
        parts.append(table(("", *head), rows))
    others = [item for item in figures.items() if item[0].rpartition(": ")[0] not in wide]
    rows = [
        (_joined([name for name, _ in alike]), value)
        for value, alike in groupby(others, key=lambda item: item[1])
    ]
    return "\n\n".join([*parts, table(("", "figure"), rows)])


def _joined(names: list[str]) -> str:
    """One name for several: what they begin with, each one's own words, what they end with."""
    split = [name.rpartition(": ") for name in names]
    labels = [label.split() or kind.split() for label, _, kind in split]
    same = takewhile(lambda words: len(set(words)) == 1, zip(*labels, strict=False))
    first = len(list(same))
    own = ", ".join(" ".join(words[first:]) for words in labels)
    end = f": {split[0][2]}" if split[0][0] else ""
    return " ".join([*labels[0][:first], own]).strip() + end if len(names) > 1 else names[0]
