"""The pictures of the rows, for the documentation."""

from collections.abc import Sequence
from pathlib import Path

from service.simulate.drawing import pictures_in
from studies.star_image_report.claims import Row


def draw(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Draw every picture of the rows; the files written.

    Raises `NotAvailable` where matplotlib is not installed.
    """
    with pictures_in(folder, "imaging") as pictures:
        for row in rows:
            for name, picture in row.pictures.items():
                figure = pictures.figure(*picture.size)
                picture.draw(figure)
                pictures.save(figure, name)
    return pictures.written
