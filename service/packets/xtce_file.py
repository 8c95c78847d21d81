"""An XTCE file as XML: checked, and written anew in the form that space-packet-parser reads.

The file comes from outside.  No document type is accepted, so that no entity is expanded, and
nothing that the file names is opened: no schema, no include.  Arrays and aggregates become
single parameters, NAME[0] and NAME.MEMBER, as XTCE references write them.  What the package
would pass over without a word, such as an entry at a place of its own, is refused by line.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

from service.errors import BadFile, Fault, shown_value

NAMESPACE = "http://www.omg.org/spec/XTCE/20180204"
MAX_BYTES = 16 << 20
MAX_CONTAINERS = 4_000
MAX_PARAMETERS = 100_000
MAX_EXPONENT = 64
MAX_BITS = 8 * (65536 + 6)
MAX_DEPTH = 16
"""Arrays of aggregates of arrays, so deep."""

_XTCE_WORD = "xtce"
_MOVED = ("LocationInContainerInBits", "RepeatEntry", "IncludeCondition")
_SPELLINGS = {"IEEE-754": "IEEE754", "MIL-1750A": "MILSTD_1750A"}
_EMPTY_NAMES = ("name", "parameterRef", "containerRef", "parameterTypeRef")


class XtceFault(Exception):
    """A fault in the file, with its line."""

    def __init__(self, element: Any, message: str, value: object = None) -> None:
        super().__init__(message)
        self.line = element if isinstance(element, int) else int(element.sourceline or 0)
        self.message = message
        self.value = None if value is None else shown_value(value)


def normalised_xtce(text: bytes, file: str) -> bytes:
    """The XML of a file in one namespace, without arrays.

    Raises `BadFile` naming the file, the line and what is wrong.
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
    """Give every element the namespace of XTCE 1.2, whichever the file has or lacks."""
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
    """Replaces arrays and aggregates by their members, and refuses what would be misread."""

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
        """Refuse sizes and powers that would take unbounded time or memory for each packet."""
        for each in kind.iter(_named("Term")):
            if not 0 <= _whole(each, "exponent") <= MAX_EXPONENT:
                message = f"an exponent must be from 0 to {MAX_EXPONENT}"
                raise XtceFault(each, message, each.get("exponent"))
        for each in kind.iter():
            if "sizeInBits" in each.attrib and not 1 <= _whole(each, "sizeInBits") <= MAX_BITS:
                message = f"sizeInBits must be from 1 to {MAX_BITS}"
                raise XtceFault(each, message, each.get("sizeInBits"))

    def _require_clear(self, kind: Any) -> None:
        """Settle what the package would warn of or pass over: spellings, orders, odd booleans."""
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
        if self._local(kind) == "BooleanParameterType":
            for word in ("StringDataEncoding", "BinaryDataEncoding"):
                if kind.find(f".//{_named(word)}") is not None:
                    raise XtceFault(kind, f"a boolean with a {word} is not supported")

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
        """An entry must follow the one before it, once and in every packet."""
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
        """The single parameters of a compound one, with their types, in order."""
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
