"""Output files of studies: rows as JSON, pictures, and links to pictures.

matplotlib is imported when a picture is drawn: it comes with the extra `plots`.
"""

import json
import os.path
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.extras import require_extra

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def json_rows(rows: Iterable[Any]) -> str:
    """Format rows as a JSON array, one row per line."""
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows)
    return f"[\n{lines}\n]\n" if lines else "[]\n"


def links(title: str, picture: Path, file: Path) -> list[str]:
    """Markdown link to a picture, relative to the page `file`; empty without the picture."""
    return [f"![{title}]({os.path.relpath(picture, file.parent)})"] if picture.exists() else []


class Folder:
    """A folder for pictures, with the list of pictures written to it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.written: list[Path] = []

    def figure(self, width_in: float, height_in: float) -> "Figure":
        """Create an empty matplotlib figure of a size in inches."""
        from matplotlib.figure import Figure

        return Figure(figsize=(width_in, height_in), layout="constrained")

    def save(self, figure: "Figure", name: str) -> None:
        """Write a figure as SVG; equal data give an equal file, independent of the date."""
        path = self.path / f"{name}.svg"
        figure.savefig(path, metadata={"Date": None})
        self.written.append(path)


@contextmanager
def pictures_in(path: Path, salt: str) -> Iterator[Folder]:
    """Context manager of a folder for pictures with one style; the folder is created if missing.

    `salt` makes the ids in the files reproducible.  Raises `NotAvailable` without matplotlib.
    """
    require_extra("plots", "matplotlib", "pictures", str(path))
    import matplotlib as mpl

    path.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(
        {"svg.hashsalt": salt, "font.size": 9, "axes.grid": True, "grid.alpha": 0.3}
    ):
        yield Folder(path)
