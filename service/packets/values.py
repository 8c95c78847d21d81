"""Single values of a packet as the numbers that a batch takes; a fault names the parameter."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from service.packets.definition import PacketFault

EXACT = 1 << 53
"""Whole numbers up to this are exact as a float."""


def number(values: Mapping[str, Any], name: str) -> float:
    """A value as a float, NaN and infinity included; raises `PacketFault` where it is no number."""
    value = _present(values, name)
    if not isinstance(value, int | float):
        raise PacketFault(name, "must be a number", value)
    try:
        return float(value)
    except OverflowError:
        raise PacketFault(name, "is beyond every number of a batch") from None


def finite(values: Mapping[str, Any], name: str) -> float:
    """A value that is a number; raises `PacketFault` for NaN and infinity too."""
    value = number(values, name)
    if not math.isfinite(value):
        raise PacketFault(name, "must be finite", value)
    return value


def finite_all(values: Mapping[str, Any], names: Sequence[str], scale: float = 1.0) -> list[float]:
    """Several values, each times `scale`."""
    return [finite(values, name) * scale for name in names]


def whole(values: Mapping[str, Any], name: str) -> int:
    """A value that is a whole number; a float without a fraction is one."""
    value = _present(values, name)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float) and value.is_integer() and abs(value) <= EXACT:
        return int(value)
    raise PacketFault(name, "must be a whole number", value)


def text(values: Mapping[str, Any], name: str) -> str:
    """A value as text: a string without its padding, or a whole number in digits."""
    value = _present(values, name)
    if isinstance(value, bytes):
        try:
            value = value.decode("ascii")
        except UnicodeDecodeError:
            raise PacketFault(name, "must be text", value) from None
    if isinstance(value, str):
        return value.rstrip("\0 ").rstrip()
    return str(whole(values, name))


def _present(values: Mapping[str, Any], name: str) -> Any:
    try:
        return values[name]
    except KeyError:
        raise PacketFault(name, "is not in the packet") from None
