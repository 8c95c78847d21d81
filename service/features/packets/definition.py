"""Packet definitions in XTCE: parse the bytes of a packet to parameters by name.

The XML is checked, and rewritten in the form that space-packet-parser reads.  Files are untrusted.
No document type is accepted, so that no entity is expanded, and no file named in it is opened: no
schema, no include.  Arrays and aggregates become single parameters, NAME[0] and NAME.MEMBER, as
XTCE references write them.  Elements that the package would silently ignore, such as an entry with
its own location, are refused by line.
"""

import io
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from service.errors import BadFile, Fault, shown_value
from service.extras import require_extra

NAMESPACE = "http://www.omg.org/spec/XTCE/20180204"
MAX_BYTES = 16 << 20
MAX_CONTAINERS = 4_000
MAX_PARAMETERS = 100_000
MAX_EXPONENT = 64
MAX_BITS = 8 * (65536 + 6)
MAX_LABELLED = 65_536
MAX_DEPTH = 16
"""Greatest depth to which arrays and aggregates of an XTCE file may be nested."""

_XTCE_WORD = "xtce"
_MOVED = ("LocationInContainerInBits", "RepeatEntry", "IncludeCondition")
_SPELLINGS = {"IEEE-754": "IEEE754", "MIL-1750A": "MILSTD_1750A"}
_EMPTY_NAMES = ("name", "parameterRef", "containerRef", "parameterTypeRef")


class XtceFault(Exception):
    """A fault in an XTCE file, with its line."""

    def __init__(self, element: Any, message: str, value: object = None) -> None:
        super().__init__(message)
        self.line = element if isinstance(element, int) else int(element.sourceline or 0)
        self.message = message
        self.value = None if value is None else shown_value(value)


def normalised_xtce(text: bytes, file: str) -> bytes:
    """Rewrite the XML of an XTCE file in one namespace and without arrays.

    Raises `BadFile` naming the file, the line and the fault.
    """
    try:
        return _normalised(text)
    except XtceFault as fault:
        field = f"{file}, line {fault.line}" if fault.line else file
        raise BadFile(Fault(field, fault.message, fault.value)) from None


def _normalised(text: bytes) -> bytes:
    from lxml import etree

    if len(text) > MAX_BYTES:
        raise XtceFault(0, f"is larger than {MAX_BYTES >> 20} MiB")
    for word in (b"<!DOCTYPE", b"<!ENTITY"):
        if word in text:
            line = text.count(b"\n", 0, text.index(word)) + 1
            raise XtceFault(line, "a document type and its entities are not accepted in XTCE")
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
    )
    try:
        root = etree.fromstring(text, parser)
    except etree.XMLSyntaxError as error:
        raise XtceFault(error.lineno or 0, f"is not XML: {error.msg}") from None
    except ValueError as error:
        raise XtceFault(0, f"is not XML: {error}") from None
    if root.getroottree().docinfo.doctype:
        raise XtceFault(1, "a document type and its entities are not accepted in XTCE")
    _into_one_namespace(root, etree)
    _Expansion(root, etree).run()
    return bytes(etree.tostring(root))


def _into_one_namespace(root: Any, etree: Any) -> None:
    """Move every element to the namespace of XTCE 1.2, from any other XTCE namespace or none."""
    name = etree.QName(root)
    if name.localname != "SpaceSystem":
        raise XtceFault(root, "must have the root SpaceSystem", name.localname)
    own = name.namespace
    if own is not None and _XTCE_WORD not in own.lower():
        raise XtceFault(root, "the root is not in a namespace of XTCE", own)
    for element in root.iter():
        if not isinstance(element.tag, str):
            raise XtceFault(element, "an entity is not accepted in XTCE")
        each = etree.QName(element)
        if each.namespace != own:
            message = "an element of another namespace; nothing is included from elsewhere"
            raise XtceFault(element, message, element.tag)
        element.tag = f"{{{NAMESPACE}}}{each.localname}"
        for key in _EMPTY_NAMES:
            if element.get(key) == "":
                raise XtceFault(element, f"{key} is empty")
    etree.cleanup_namespaces(root, top_nsmap={_XTCE_WORD: NAMESPACE})


def _named(name: str) -> str:
    return f"{{{NAMESPACE}}}{name}"


class _Expansion:
    """Replaces arrays and aggregates by single parameters, and refuses ambiguous XTCE elements."""

    def __init__(self, root: Any, etree: Any) -> None:
        self._root, self._etree = root, etree
        self._types: dict[str, Any] = {}
        self._parameters: dict[str, Any] = {}
        self._made = 0

    def run(self) -> None:
        types = self._only("TelemetryMetaData/ParameterTypeSet")
        parameters = self._only("TelemetryMetaData/ParameterSet")
        containers = self._only("TelemetryMetaData/ContainerSet")
        if len(containers) > MAX_CONTAINERS:
            raise XtceFault(containers, f"has more than {MAX_CONTAINERS} containers")
        self._types = {self._attribute(each, "name"): each for each in types}
        self._parameters = {self._attribute(each, "name"): each for each in parameters}
        for each in types:
            self._require_bounded(each)
            self._require_clear(each)
        for container in containers:
            self._expand_entries(container, parameters)
        for each in parameters:
            if self._is_compound(each.get("parameterTypeRef")):
                parameters.remove(each)
        for each in types:
            if self._local(each) in _MEMBERS:
                types.remove(each)

    def _only(self, path: str) -> Any:
        found = self._root.findall("/".join(_named(part) for part in path.split("/")))
        if len(found) != 1:
            raise XtceFault(self._root, f"must hold one {path}; there are {len(found)}")
        return found[0]

    def _local(self, element: Any) -> str:
        return str(self._etree.QName(element).localname)

    def _attribute(self, element: Any, name: str) -> str:
        value = element.get(name)
        if value is None:
            raise XtceFault(element, f"{self._local(element)} has no {name}")
        return str(value)

    def _require_bounded(self, kind: Any) -> None:
        """Refuse sizes and exponents that would cost unbounded time or memory for each packet."""
        for each in kind.iter(_named("Term")):
            if not 0 <= _whole(each, "exponent") <= MAX_EXPONENT:
                message = f"an exponent must be from 0 to {MAX_EXPONENT}"
                raise XtceFault(each, message, each.get("exponent"))
        for each in kind.iter():
            if "sizeInBits" in each.attrib and not 1 <= _whole(each, "sizeInBits") <= MAX_BITS:
                message = f"sizeInBits must be from 1 to {MAX_BITS}"
                raise XtceFault(each, message, each.get("sizeInBits"))

    def _require_clear(self, kind: Any) -> None:
        """Normalise or refuse spellings, byte orders and booleans that the library would ignore."""
        for each in kind.iter(_named("FloatDataEncoding")):
            spelling = each.get("encoding")
            if spelling in _SPELLINGS:
                each.set("encoding", _SPELLINGS[spelling])
        for each in kind.iter(_named("ByteOrderList")):
            # XTCE 1.1 lists the bytes; 1.2 has an attribute for the two orders that are read.
            order = [_whole(byte, "byteSignificance") for byte in each]
            if order not in (sorted(order), sorted(order, reverse=True)):
                raise XtceFault(each, "must ascend or descend", str(order))
            ends = "least" if order == sorted(order) else "most"
            each.getparent().set("byteOrder", f"{ends}SignificantByteFirst")
        for each in kind.iter():
            if each.get("bitOrder") == "leastSignificantBitFirst":
                raise XtceFault(each, "bitOrder leastSignificantBitFirst is not supported")
        if self._local(kind) == "EnumeratedParameterType":
            for each in list(kind.iter(_named("Enumeration"))):
                self._list_range(each)
        if self._local(kind) == "BooleanParameterType":
            for word in ("StringDataEncoding", "BinaryDataEncoding"):
                if kind.find(f".//{_named(word)}") is not None:
                    raise XtceFault(kind, f"a boolean with a {word} is not supported")

    def _list_range(self, entry: Any) -> None:
        """Expand an enumeration label with `maxValue` to one entry for each number."""
        last = entry.get("maxValue")
        if last is None:
            return
        del entry.attrib["maxValue"]
        try:
            numbers = range(int(entry.get("value", "")), int(last) + 1)
        except ValueError:
            raise XtceFault(entry, "value and maxValue must be whole numbers", last) from None
        if not 0 < len(numbers) <= MAX_LABELLED:
            message = f"maxValue must be from value to {MAX_LABELLED} numbers on"
            raise XtceFault(entry, message, last)
        for number in reversed(numbers[1:]):
            copy = self._etree.Element(entry.tag, value=str(number), label=entry.get("label", ""))
            entry.addnext(copy)

    def _is_compound(self, type_name: str | None) -> bool:
        kind = self._types.get(type_name or "")
        return kind is not None and self._local(kind) in _MEMBERS

    def _expand_entries(self, container: Any, parameters: Any) -> None:
        entries = container.find(_named("EntryList"))
        if entries is None:
            raise XtceFault(container, f"{self._attribute(container, 'name')} has no EntryList")
        for entry in list(entries):
            self._require_in_order(entry)
            kind = self._local(entry)
            if kind == "ContainerRefEntry":
                self._attribute(entry, "containerRef")
                continue
            if kind not in ("ParameterRefEntry", "ArrayParameterRefEntry"):
                raise XtceFault(entry, f"{kind} is not supported in an EntryList")
            name = self._attribute(entry, "parameterRef")
            parameter = self._parameters.get(name)
            if parameter is None:
                raise XtceFault(entry, "parameterRef names no parameter of the file", name)
            type_name = self._attribute(parameter, "parameterTypeRef")
            if not self._is_compound(type_name):
                if type_name not in self._types:
                    message = "parameterTypeRef names no type of the file"
                    raise XtceFault(parameter, message, type_name)
                continue
            sizes = entry.find(_named("DimensionList"))
            for member, member_type in self._members(name, type_name, entry, sizes, 0):
                self._add(member, member_type, parameters)
                ref = self._etree.Element(_named("ParameterRefEntry"), parameterRef=member)
                entry.addprevious(ref)
            entries.remove(entry)

    def _require_in_order(self, entry: Any) -> None:
        """Refuse an entry with its own location, a repetition or a condition."""
        for word in _MOVED:
            found = entry.find(_named(word))
            if found is None:
                continue
            place = found.get("referenceLocation", "previousEntry")
            value = "".join(found.itertext()).strip()
            if word != "LocationInContainerInBits" or place != "previousEntry" or value != "0":
                raise XtceFault(found, f"{word} is not supported: entries must follow each other")

    def _add(self, name: str, type_name: str, parameters: Any) -> None:
        if name in self._parameters:
            return
        self._made += 1
        if self._made > MAX_PARAMETERS:
            raise XtceFault(parameters, f"arrays have more than {MAX_PARAMETERS} elements")
        made = self._etree.SubElement(
            parameters, _named("Parameter"), name=name, parameterTypeRef=type_name
        )
        self._parameters[name] = made

    def _members(
        self, name: str, type_name: str, entry: Any, sizes: Any, depth: int
    ) -> Iterator[tuple[str, str]]:
        """Single parameters of a compound parameter, with their types, in order."""
        kind = self._types.get(type_name)
        if kind is None:
            raise XtceFault(entry, f"{name} has a type that is not in the file", type_name)
        members = _MEMBERS.get(self._local(kind))
        if members is None:
            yield name, type_name
            return
        if depth >= MAX_DEPTH:
            raise XtceFault(kind, f"{name} is nested deeper than {MAX_DEPTH}")
        for suffix, member_type in members(kind, sizes):
            yield from self._members(name + suffix, member_type, entry, None, depth + 1)


def _array_members(kind: Any, sizes: Any) -> Iterator[tuple[str, str]]:
    element_type = kind.get("arrayTypeRef")
    dimensions = kind.find(_named("DimensionList")) if sizes is None else sizes
    if element_type is None or dimensions is None:
        raise XtceFault(kind, "an array must have arrayTypeRef and a DimensionList")
    ranges = [_range(each) for each in dimensions]
    if not ranges or math.prod(len(each) for each in ranges) > MAX_PARAMETERS:
        raise XtceFault(kind, f"an array must have from 1 to {MAX_PARAMETERS} elements")
    places = [""]
    for each in ranges:
        places = [f"{place}[{index}]" for place in places for index in each]
    for place in places:
        yield place, element_type


def _range(dimension: Any) -> range:
    ends = []
    for name in ("StartingIndex", "EndingIndex"):
        value = dimension.find(f"{_named(name)}/{_named('FixedValue')}")
        if value is None:
            raise XtceFault(dimension, f"{name} of an array must be a FixedValue")
        ends.append(_integer(value, value.text))
    start, end = ends
    if not 0 <= start <= end < MAX_PARAMETERS:
        raise XtceFault(dimension, "the indices of an array must ascend from 0", f"{start}, {end}")
    return range(start, end + 1)


def _aggregate_members(kind: Any, sizes: Any) -> Iterator[tuple[str, str]]:
    members = kind.find(_named("MemberList"))
    for member in () if members is None else members:
        name, member_type = member.get("name"), member.get("typeRef")
        if name is None or member_type is None:
            raise XtceFault(member, "a member of an aggregate must have name and typeRef")
        yield f".{name}", member_type


_MEMBERS: dict[str, Callable[[Any, Any], Iterator[tuple[str, str]]]] = {
    "ArrayParameterType": _array_members,
    "AggregateParameterType": _aggregate_members,
}


def _whole(element: Any, name: str) -> int:
    return _integer(element, element.get(name))


def _integer(element: Any, text: str | None) -> int:
    digits = (text or "").strip()
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 12):
        raise XtceFault(element, "must be a whole number of at most 12 digits", text)
    return int(digits)


MAX_ENTRIES = 20_000
"""Greatest number of entries in one packet, nested containers included."""

_LOADING = threading.Lock()
"""Lock on loading XTCE files, since space-packet-parser keeps their namespaces in a class."""


class UnknownPacket(Exception):
    """Raised if no container of the XTCE file describes a packet."""


class PacketFault(Exception):
    """Raised if a packet does not match its description in the XTCE file."""

    def __init__(self, parameter: str, message: str, value: object = None) -> None:
        super().__init__(message)
        self.parameter = parameter
        self.message = message
        self.value = None if value is None else shown_value(value)


@dataclass(frozen=True)
class ParameterKind:
    """Kind of value of a parameter; for enumerations and named booleans the labels with numbers.

    The number is None if a label stands for a text, or for zero and another number.
    """

    kind: Literal["number", "boolean", "enumerated", "text", "binary"]
    labels: Mapping[str, float | None] = field(default_factory=dict)
    unit: str = ""
    """Unit of the calibrated value as the XTCE file names it, such as `seconds`."""
    time_epoch: str = ""
    """Epoch of an absolute time as the XTCE file names it, such as `GPS` or `1958-01-01`."""
    time_scale: float = 1.0
    """Factor by which the XTCE file multiplies the count of a time."""


class PacketDefinition:
    """Parses packets as described by an XTCE file; `name` identifies the file in messages."""

    def __init__(self, text: bytes, name: str, root_container: str) -> None:
        """Load XTCE text; raises `BadFile` naming the file, `NotAvailable` without the package."""
        require_extra("packets", "space_packet_parser", "packets", name)
        self.name = name
        normalised = normalised_xtce(text, name)
        self._containers = _loaded(normalised, name)
        named = _named_booleans(normalised)
        if root_container not in self._containers:
            known = ", ".join(list(self._containers)[:20])
            message = (
                f"has no container {root_container} (packets.root_container); there is {known}"
            )
            raise BadFile(Fault(name, message))
        self._root = self._containers[root_container]
        _require_bounded(self._containers, name)
        self.parameters: dict[str, ParameterKind] = {
            entry.name: _kind_of(entry.parameter_type, named)
            for each in self._containers.values()
            for entry in each.entry_list
            if not hasattr(entry, "entry_list")
        }
        """The kinds of the parameters that containers hold, by name."""

    def read(self, packet: bytes) -> Mapping[str, Any]:
        """Calibrated values of a packet's parameters by name.

        Raises `UnknownPacket`, and `PacketFault` naming the parameter at which parsing failed.
        """
        from space_packet_parser import SpacePacket

        values: Any = SpacePacket(binary_data=packet)
        container = self._root
        while True:
            for entry in container.entry_list:
                try:
                    entry.parse(values)
                except Exception as error:
                    # The library may raise any exception for an untrusted XTCE file.
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
    """Read packet definitions from a file; raises as `PacketDefinition`, and for a missing file."""
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
        # The library may raise any exception for an unexpected element.
        why = f"is not read: {type(error).__name__}: {str(error)[:300]}"
        raise BadFile(Fault(name, why)) from None
    return dict(found.containers)


def _require_bounded(containers: dict[str, Any], file: str) -> None:
    """Refuse containers nested so often that parsing a packet would take minutes."""
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


def _named_booleans(normalised: bytes) -> dict[str, dict[str, float | None]]:
    """Labels of boolean types whose XTCE names them, which the library leaves out, by type."""
    from lxml import etree

    found = {}
    for kind in etree.fromstring(normalised).iter(_named("BooleanParameterType")):
        if "zeroStringValue" in kind.attrib or "oneStringValue" in kind.attrib:
            zero, one = kind.get("zeroStringValue", "False"), kind.get("oneStringValue", "True")
            found[str(kind.get("name"))] = _labels([(0, zero), (1, one)])
    return found


def _labels(entries: Iterable[tuple[Any, str]]) -> dict[str, float | None]:
    labels: dict[str, float | None] = {}
    for raw, label in entries:
        # A value of a text encoding is bytes.
        number = raw if isinstance(raw, int | float) else None
        if label in labels and bool(labels[label]) != bool(number):
            number = None
        labels[label] = number
    return labels


def _kind_of(
    parameter_type: Any, named_booleans: Mapping[str, Mapping[str, float | None]]
) -> ParameterKind:
    name = type(parameter_type).__name__.removesuffix("ParameterType")
    encoding = type(parameter_type.encoding).__name__
    if name == "Enumerated":
        return ParameterKind("enumerated", _labels(parameter_type.enumeration.items()))
    if name == "Boolean":
        return ParameterKind("boolean", named_booleans.get(parameter_type.name, {}))
    if encoding == "StringDataEncoding":
        return ParameterKind("text")
    if encoding == "BinaryDataEncoding":
        return ParameterKind("binary")
    # A unit of several, such as m/s, is a tuple: no unit of time.
    unit = parameter_type.unit.strip() if isinstance(parameter_type.unit, str) else ""
    if name not in ("AbsoluteTime", "RelativeTime"):
        return ParameterKind("number", unit=unit)
    calibrator = parameter_type.encoding.default_calibrator
    factors = [
        float(each.coefficient)
        for each in getattr(calibrator, "coefficients", ())
        if each.exponent == 1
    ]
    # A whole factor is applied when packets are read, and leaves a count.
    scale = next((each for each in factors if not each.is_integer()), 1.0)
    return ParameterKind("number", {}, unit, (parameter_type.epoch or "").strip(), scale)


def _fits(container: Any, values: Any) -> bool:
    try:
        return all(each.evaluate(values) for each in container.restriction_criteria)
    except Exception as error:
        message = f"its restriction criteria cannot be evaluated: {error}"
        raise PacketFault(container.name, message) from None


def _fault(entry: Any, values: Any, error: Exception) -> PacketFault:
    """Fault naming the first unread parameter of an entry, with its position in the packet."""
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
