"""Records of problems (RFC 9457), and of the faults that they list."""

from typing import Annotated, ClassVar

from msgspec import UNSET, UnsetType

from service.contract.base import Record, doc


class FieldFault(Record, frozen=True, kw_only=True):
    """Fault of one field of a request."""

    component: ClassVar[str] = "FaultOut"
    field: str
    message: str
    value: str | None


class Problem(Record, frozen=True, kw_only=True):
    """Problem details of a refused or failed request (RFC 9457)."""

    client_name: ClassVar[str] = "ProblemDocument"
    type: Annotated[str, doc("The type of problem; `about:blank` if the status says everything.")]
    title: str
    status: int
    detail: str
    instance: Annotated[str, doc("The path of the request.")]
    errors: Annotated[list[FieldFault] | UnsetType, doc("Every fault, field by field.")] = UNSET
