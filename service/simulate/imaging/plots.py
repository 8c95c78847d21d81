"""The pictures of the rows, for the documentation.

matplotlib is imported when a picture is drawn: it is there where the project
is developed, not where it only runs.
"""

from collections.abc import Sequence
from pathlib import Path

from service.errors import Fault, NotAvailable
from service.simulate.imaging.claims import Row


def draw(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Draw every picture of the rows; the files written.

    Raises `NotAvailable` where matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        raise NotAvailable(
            Fault("plots", "needs matplotlib, one of the development packages")
        ) from None
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    # The same numbers give the same file: nothing in it tells when it was drawn.
    with mpl.rc_context(
        {"svg.hashsalt": "imaging", "font.size": 9, "axes.grid": True, "grid.alpha": 0.3}
    ):
        for row in rows:
            for name, picture in row.pictures.items():
                figure = Figure(figsize=picture.size, layout="constrained")
                picture.draw(figure)
                path = folder / f"{name}.svg"
                figure.savefig(path, metadata={"Date": None})
                written.append(path)
    return written
