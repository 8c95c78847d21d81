"""Paths of data files that are shipped with the code.

In a checkout the star catalog and the migrations stand beside the package; in an installed wheel
they lie inside it, in `service/_shipped`.
"""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def shipped(*parts: str) -> Path:
    """Path of a shipped file or folder, as in `shipped("catalogs", "stars.npz")`.

    `parts` are the names of the path in the checkout.  A missing file is reported only when
    it is opened.
    """
    inside = _PACKAGE / "_shipped"
    return (inside if inside.is_dir() else _PACKAGE.parent).joinpath(*parts)
