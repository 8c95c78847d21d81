"""Shipped missions without their table `[gyro]`, as a site's mission without a gyro is."""

import re

from service.missions.mission import SHIPPED_FOLDER, Mission, parse_mission

_TABLE = re.compile(r"^\[gyro\]\n(?:\w.*\n)+", re.MULTILINE)


def text_without_gyro(name: str) -> str:
    """The mission file of a shipped spacecraft, less the table."""
    text, removed = _TABLE.subn(
        "", (SHIPPED_FOLDER / f"{name.lower()}.toml").read_text(encoding="utf-8")
    )
    assert removed == 1
    return text


def mission_without_gyro(name: str) -> Mission:
    """The mission of that file; its digest is its own, too."""
    return parse_mission(text_without_gyro(name), f"{name.lower()}.toml")
