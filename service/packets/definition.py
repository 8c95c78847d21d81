"""The packets that an XTCE file describes: from the bytes of one to its parameters by name."""

import io
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.errors import BadFile, Fault, shown_value
from service.extras import require_extra
from service.packets.xtce_file import MAX_BYTES, normalised_xtce

MAX_ENTRIES = 20_000
"""The most entries of one packet, with those of the containers in it."""

_LOADING = threading.Lock()
"""While it loads a file, space-packet-parser keeps the file's namespaces in a class."""


class UnknownPacket(Exception):
    """No container of the XTCE file describes the packet."""


class PacketFault(Exception):
    """A packet that does not have the form that the XTCE file gives it."""

    def __init__(self, parameter: str, message: str, value: object = None) -> None:
        super().__init__(message)
        self.parameter = parameter
        self.message = message
        self.value = None if value is None else shown_value(value)


class PacketDefinition:
    """Reads packets as an XTCE file describes them; `name` is that of the file in messages."""

    def __init__(self, text: bytes, name: str, root_container: str) -> None:
        """Raises `BadFile` naming the file, and `NotAvailable` without space-packet-parser."""
        require_extra("packets", "space_packet_parser", "packets", name)
        self.name = name
        self._containers = _loaded(normalised_xtce(text, name), name)
        if root_container not in self._containers:
            known = ", ".join(list(self._containers)[:20])
            message = (
                f"has no container {root_container} (packets.root_container); there is {known}"
            )
            raise BadFile(Fault(name, message))
        self._root = self._containers[root_container]
        _require_bounded(self._containers, name)
        self.parameters = frozenset(
            entry for each in self._containers.values() for entry in _parameter_names(each)
        )

    def read(self, packet: bytes) -> Mapping[str, Any]:
        """The calibrated values of a packet's parameters by name.

        Raises `UnknownPacket`, and `PacketFault` naming the parameter at which reading failed.
        """
        from space_packet_parser import SpacePacket

        values: Any = SpacePacket(binary_data=packet)
        container = self._root
        while True:
            for entry in container.entry_list:
                try:
                    entry.parse(values)
                except Exception as error:
                    # Of a file from outside the package may raise anything.
                    raise _fault(entry, values, error) from None
            fitting = [each for each in self._heirs(container) if _fits(each, values)]
            if len(fitting) > 1:
                names = ", ".join(each.name for each in fitting)
                raise PacketFault(container.name, f"several containers describe it: {names}")
            if not fitting:
                break
            container = fitting[0]
        if container.abstract or (container is self._root and container.inheritors):
            raise UnknownPacket
        read_bits, bits = values._parsing_pos, 8 * len(packet)
        if read_bits != bits:
            message = f"has {bits / 8:g} bytes, the XTCE file describes {read_bits / 8:g}"
            raise PacketFault(container.name, message)
        found: Mapping[str, Any] = values
        return found

    def _heirs(self, container: Any) -> list[Any]:
        return [self._containers[name] for name in container.inheritors]


def read_definition(path: Path, root_container: str) -> PacketDefinition:
    """The definition of a file; raises as `PacketDefinition`, and for a file that is missing."""
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        message = f"cannot be opened: {error.strerror or error}"
        raise BadFile(Fault(str(path), message)) from None
    return PacketDefinition(text, str(path), root_container)


def _loaded(text: bytes, name: str) -> dict[str, Any]:
    from space_packet_parser.xtce.definitions import XtcePacketDefinition

    try:
        with _LOADING:
            found = XtcePacketDefinition.from_xtce(io.BytesIO(text))
    except RecursionError:
        raise BadFile(Fault(name, "a container refers to itself")) from None
    except Exception as error:
        # The package raises whatever an unexpected element leads to.
        why = f"is not read: {type(error).__name__}: {str(error)[:300]}"
        raise BadFile(Fault(name, why)) from None
    return dict(found.containers)


def _require_bounded(containers: dict[str, Any], file: str) -> None:
    """Refuse containers that hold each other so often that one packet takes minutes."""
    sizes: dict[str, int] = {}
    for container in containers.values():
        if _entries(container, sizes) > MAX_ENTRIES:
            message = f"container {container.name} has more than {MAX_ENTRIES} entries"
            raise BadFile(Fault(file, message))


def _entries(container: Any, sizes: dict[str, int]) -> int:
    if container.name not in sizes:
        sizes[container.name] = sum(
            _entries(entry, sizes) if hasattr(entry, "entry_list") else 1
            for entry in container.entry_list
        )
    return min(sizes[container.name], MAX_ENTRIES + 1)


def _parameter_names(container: Any) -> list[str]:
    return [entry.name for entry in container.entry_list if not hasattr(entry, "entry_list")]


def _fits(container: Any, values: Any) -> bool:
    try:
        return all(each.evaluate(values) for each in container.restriction_criteria)
    except Exception as error:
        message = f"its restriction criteria cannot be evaluated: {error}"
        raise PacketFault(container.name, message) from None


def _fault(entry: Any, values: Any, error: Exception) -> PacketFault:
    """The fault of the first parameter of an entry that was not read."""
    while hasattr(entry, "entry_list"):
        missing = [each for each in entry.entry_list if not _is_read(each, values)]
        if not missing:
            break
        entry = missing[0]
    place = f"at byte {values._parsing_pos / 8:g}"
    if isinstance(error, ValueError) and "beyond the end" in str(error):
        length = len(values.binary_data)
        message = f"begins {place} of the packet and does not fit: the packet has {length} bytes"
        return PacketFault(entry.name, message)
    return PacketFault(
        entry.name, f"cannot be read {place} of the packet: {type(error).__name__}: {error}"[:300]
    )


def _is_read(entry: Any, values: Any) -> bool:
    if hasattr(entry, "entry_list"):
        return all(_is_read(each, values) for each in entry.entry_list)
    return entry.name in values
