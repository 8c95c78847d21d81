"""Records of problems (RFC 9457), and of the faults that they list."""
# Written by `make client` from service/contract/problems.py.

from collections.abc import Sequence

from ..base import Model


class FieldFault(Model, frozen=True, kw_only=True):
    """Fault of one field of a request."""

    field: str
    message: str
    value: str | None


class ProblemDocument(Model, frozen=True, kw_only=True):
    """Problem details of a refused or failed request (RFC 9457)."""

    type: str
    """The type of problem; `about:blank` if the status says everything."""
    title: str
    status: int
    detail: str
    instance: str
    """The path of the request."""
    errors: Sequence[FieldFault] = ()
    """Every fault, field by field."""
