"""The caller, and the audit list of changes."""

from typing import Annotated, ClassVar, Literal

from service.storage.models.base import Id, Record, Stamp, doc

Scope = Literal["read", "submit", "operate"]


class Session(Record, frozen=True, kw_only=True):
    """The caller and its scopes."""

    component: ClassVar[str] = "Session"
    name: Annotated[
        str | None, doc("The token's name, which the audit list records with each change.")
    ]
    scopes: list[Scope]
    spacecraft: Annotated[
        list[str] | None, doc("Spacecraft that the token is bound to; null: all.")
    ]


class AuditEntry(Record, frozen=True, kw_only=True):
    """One change."""

    component: ClassVar[str] = "AuditRow"
    id: Id
    moment: Stamp
    who: Annotated[str, doc("The token's name; `local` while access is open.")]
    action: Annotated[str, doc("The operation's name in this description.")]
    about: Annotated[str, doc("Path and query of the request.")]
    body: Annotated[str | None, doc("The body of the request; of a long one, the beginning.")]
    status: Annotated[int | None, doc("Status of the answer; null for an action of a command.")]


class AuditPage(Record, frozen=True, kw_only=True):
    """A page of changes."""

    component: ClassVar[str] = "AuditPage"
    items: list[AuditEntry]
    next_cursor: str | None
