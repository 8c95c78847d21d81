"""Files that studies write: rows as JSON, pictures and links to them.

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
    """Rows as a JSON array, one a line."""
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows)
    return f"[\n{lines}\n]\n" if lines else "[]\n"


def links(title: str, picture: Path, file: Path) -> list[str]:
    """The link to a picture, as seen from the page `file`; none without the picture."""
    return [f"![{title}]({os.path.relpath(picture, file.parent)})"] if picture.exists() else []


class Folder:
    """A folder for pictures, and those written to it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.written: list[Path] = []

    def figure(self, width_in: float, height_in: float) -> "Figure":
        """A new picture of a size."""
        from matplotlib.figure import Figure

        return Figure(figsize=(width_in, height_in), layout="constrained")

    def save(self, figure: "Figure", name: str) -> None:
        """Write it as SVG; the same numbers give the same file, whenever it is drawn."""
        path = self.path / f"{name}.svg"
        figure.savefig(path, metadata={"Date": None})
        self.written.append(path)


@contextmanager
def pictures_in(path: Path, salt: str) -> Iterator[Folder]:
    """A folder, made where it is missing, and one look for what is drawn in it.

    `salt` names the parts of the files.  Raises `NotAvailable` where matplotlib
    is not installed.
    """
    require_extra("plots", "matplotlib", "pictures", str(path))
    import matplotlib as mpl

    path.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(
        {"svg.hashsalt": salt, "font.size": 9, "axes.grid": True, "grid.alpha": 0.3}
    ):
        yield Folder(path)
