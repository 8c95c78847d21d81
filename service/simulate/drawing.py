"""The common part of every picture for the documentation.

matplotlib is imported when a picture is drawn: it comes with the extra `plots`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from service.extras import require_extra

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Folder:
    """Where pictures are written, and which were."""

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
