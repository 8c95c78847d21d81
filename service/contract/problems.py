"""Problems (RFC 9457), and the faults that they name."""

from typing import Annotated, ClassVar

from msgspec import UNSET, UnsetType

from service.contract.base import Record, doc


class FieldFault(Record, frozen=True, kw_only=True):
    """One fault of a request."""

    component: ClassVar[str] = "FaultOut"
    field: str
    message: str
    value: str | None


class Problem(Record, frozen=True, kw_only=True):
    """A problem (RFC 9457)."""

    client_name: ClassVar[str] = "ProblemDocument"
    type: Annotated[str, doc("The type of problem; `about:blank` if the status says everything.")]
    title: str
    status: int
    detail: str
    instance: Annotated[str, doc("The path of the request.")]
    errors: Annotated[list[FieldFault] | UnsetType, doc("Every fault, field by field.")] = UNSET
