"""Base class of all records, with their descriptions in the OpenAPI document.

A record is a msgspec struct: storage functions create it, and the API encodes it unchanged.  Its
annotations carry pydantic's `Field` for descriptions and bounds, which msgspec ignores; the schema
in the OpenAPI document is built from them.  A description too long for the line of its field stands
below it as a text.
"""

import ast
import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Generic,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from msgspec import NODEFAULT, Struct, UnsetType, defstruct, structs
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, create_model
from pydantic_core import CoreSchema

Components = Annotated[list[float], Field(min_length=3, max_length=3)]
Quaternion = Annotated[
    list[float],
    Field(
        min_length=4,
        max_length=4,
        description="Transforms inertial into body components; scalar last, qc >= 0.",
    ),
]
Moment = Annotated[
    str,
    Field(
        description="UTC.",
        examples=["1996-01-10T12:00:00.000Z"],
        json_schema_extra={"pattern": r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3,9}Z$"},
    ),
]
"""UTC text of a batch's time, which may be in a leap second."""
Stamp = Annotated[
    str,
    Field(
        description="UTC, by the service's clock.",
        examples=["2026-03-01T12:00:00.000Z"],
        json_schema_extra={"format": "date-time"},
    ),
]
"""UTC text of a time noted by the service itself, in RFC 3339 format."""
Id = Annotated[
    str, Field(min_length=26, max_length=26, description="Ids sort by the time of recording.")
]
Digest = Annotated[str, Field(pattern=r"^sha256:[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0)]
MissionSettings = Annotated[
    dict[str, Any], Field(description="With the names of the mission file.")
]
Covariance = Annotated[
    list[Components],
    Field(
        min_length=3,
        max_length=3,
        description="Covariance of the small error rotation about the body axes.",
    ),
]


def doc(description: str) -> Any:
    """Annotation with the description of a field in the OpenAPI document."""
    return Field(description=description)


class DescribedAs:
    """Annotation that describes a field by another type than its own, such as a request's model."""

    def __init__(self, shape: Any) -> None:
        self.shape = shape

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Schema of the type that describes the field."""
        return handler.generate_schema(self.shape)


@dataclass(frozen=True)
class Absent:
    """Annotation for the meaning of an absent field, if that is neither null nor an empty list."""

    value: bool


# Stored answers may hold words of earlier versions: texts are read unchanged.
Outcome = Annotated[str, DescribedAs(Literal["unique", "ambiguous", "unmatched"])]
Status = Annotated[str, DescribedAs(Literal["good", "suspect"])]
Reason = Annotated[
    str,
    DescribedAs(
        Literal[
            "fewer_than_two_unique_stars",
            "degenerate_geometry",
            "fewer_than_three_stars",
            "no_match",
            "doubtful_match",
        ]
    ),
]


class Record(Struct, frozen=True, kw_only=True):
    """Base class of a record in the OpenAPI document.

    `component` is its name there, by default that of the class; an empty one leaves the record
    itself out of the document, but not records derived from it.  `client_name` is the name of its
    model in the Python client, by default that of the class.
    """

    component: ClassVar[str] = ""
    client_name: ClassVar[str] = ""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Schema of the record's fields, for the OpenAPI document."""
        return handler(described(cls))


R = TypeVar("R", bound=Record)
R_co = TypeVar("R_co", covariant=True)


class Page(Struct, Generic[R_co], frozen=True):
    """Page of a list; `next_cursor` leads to the next page, None at the end."""

    items: list[R_co]
    next_cursor: str | None


def _without_defaults(schema: dict[str, Any]) -> None:
    # The default only marks a field as optional; it does not give the meaning of its absence.
    for each in schema.get("properties", {}).values():
        each.pop("default", None)


class Shape(BaseModel):
    """Base class for descriptions of JSON objects that allow no other properties."""

    model_config = ConfigDict(extra="forbid", json_schema_extra=_without_defaults)


def component_name(shape: type[BaseModel] | type[Record]) -> str:
    """Name of a record or model in the OpenAPI document."""
    return vars(shape).get("component") or shape.__name__


@cache
def described(record: type[Record]) -> type[BaseModel]:
    """Build the pydantic model that describes a record; fields that may be absent have defaults."""
    hints = get_type_hints(record, include_extras=True)
    fields: dict[str, Any] = {}
    for each in structs.fields(record):
        is_required = each.default is NODEFAULT and each.default_factory is NODEFAULT
        default = ... if is_required else None
        about: dict[str, Any] = {"description": text_below(record, each.name)}
        if each.encode_name != each.name:
            about["alias"] = each.encode_name
        known = {name: value for name, value in about.items() if value is not None}
        fields[each.name] = _without_unset(hints[each.name]), Field(default, **known)
    return create_model(component_name(record), __base__=Shape, __doc__=record.__doc__, **fields)


def text_below(record: type[Record], field: str) -> str | None:
    """Description of a record's field from the text below it, in its class or a base class."""
    owners = [each for each in record.__mro__ if issubclass(each, Record)]
    texts = (_texts_below_fields(each.__module__).get((each.__name__, field)) for each in owners)
    return next(filter(None, texts), None)


@cache
def _texts_below_fields(module: str) -> Mapping[tuple[str, str], str]:
    """Texts that stand below fields in a module's source, by class and field."""
    found = {}
    for record in ast.parse(inspect.getsource(sys.modules[module])).body:
        if isinstance(record, ast.ClassDef):
            for field, below in pairwise(record.body):
                match field, below:
                    case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                        found[record.name, name] = " ".join(text.split())
    return found


def _without_unset(kind: Any) -> Any:
    if get_origin(kind) is Annotated:
        return Annotated[(_without_unset(kind.__origin__), *kind.__metadata__)]
    if get_origin(kind) not in (Union, UnionType):
        return kind
    return Union[tuple(each for each in get_args(kind) if each is not UnsetType)]  # noqa: UP007


class Items(Record, frozen=True, kw_only=True):
    """Base class of a record for a whole list."""

    component: ClassVar[str] = ""
    items: list[Any]


def list_record(name: str, item: type[Record], description: str) -> type[Items]:
    """Create the record of a whole list."""
    return _defined(name, item, [("items", list[item])], Items, description)  # type: ignore[valid-type]


def page_record(name: str, item: type[Record], description: str) -> type[Record]:
    """Create the record that describes a `Page` of a list."""
    fields = [("items", list[item]), ("next_cursor", str | None)]  # type: ignore[valid-type]
    return _defined(name, item, fields, Record, description)


def _defined(
    name: str, item: type[Record], fields: Any, base: type[R], description: str
) -> type[R]:
    content = {"__doc__": description, "__module__": item.__module__}
    record = defstruct(name, fields, bases=(base,), namespace=content, frozen=True, kw_only=True)
    return cast(type[R], record)
