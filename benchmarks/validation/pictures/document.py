"""The measured parts of docs/cameras.md, each between two comments."""

from benchmarks.record import ROOT, record_of
from benchmarks.report import Report
from benchmarks.sections import tables_of

DOCUMENT = ROOT / "docs" / "cameras.md"
SOURCES = (
    "catalogs/stars.npz",
    "service/features/pictures/camera_calibration.py",
    "service/features/pictures/blind",
    "service/features/pictures/detection/points.py",
    "service/features/pictures/frames",
    "service/vectors.py",
    "tests/features/pictures/drawn.py",
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
