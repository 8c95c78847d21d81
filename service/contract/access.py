"""Records of access: callers, tokens, and the audit list of changes."""

from typing import Annotated, ClassVar, Literal

from service.contract.base import Id, Record, Stamp, doc, list_record, page_record

Scope = Literal["read", "submit", "operate"]


class Session(Record, frozen=True, kw_only=True):
    """The caller of a request: name, scopes and spacecraft of its token."""

    name: str | None
    """Name of the token, which the audit list records with each change."""
    scopes: list[Scope]
    spacecraft: list[str] | None
    """Spacecraft that the token is limited to; null: all."""


TokenState = Literal["good", "expired", "revoked"]


class Token(Record, frozen=True, kw_only=True):
    """An access token without its secret; the service stores only a digest of the secret."""

    name: Annotated[str, doc("The audit list records changes under it; never used again.")]
    scopes: list[Scope]
    spacecraft: list[str] | None
    """Spacecraft that the token is limited to; null: all."""
    rate_per_s: Annotated[float | None, doc("Requests per second; null: no limit.")]
    created: Stamp
    expires: Stamp
    revoked: Stamp | None
    state: TokenState


class NewToken(Token, frozen=True, kw_only=True):
    """A new access token with its secret, which no other answer shows."""

    token: Annotated[str, doc("Sent as `Authorization: Bearer acq_...`.")]


TokenList = list_record("TokenList", Token, "All tokens, the oldest first.")


class AuditEntry(Record, frozen=True, kw_only=True):
    """Entry of the audit list: a change, its author, and the request."""

    component: ClassVar[str] = "AuditRow"
    id: Id
    moment: Stamp
    who: Annotated[str, doc("The token's name; `local` while access is open.")]
    action: str
    """The operation's name in this description; `adopt_what_if` if it made a what-if current."""
    about: Annotated[str, doc("Path and query of the request.")]
    body: Annotated[str | None, doc("The body of the request; of a long one, the beginning.")]
    status: Annotated[int | None, doc("Status of the answer; null for an action of a command.")]
    person: Annotated[
        str, doc("The name that signed the request; without a signature the token's name.")
    ]
    reason: Annotated[str | None, doc("The comment or the note that was sent with it.")]


AuditPage = page_record("AuditPage", AuditEntry, "A page of changes.")
