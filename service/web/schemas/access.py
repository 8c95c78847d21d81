"""Who asks, and what was changed."""

from pydantic import Field

from service.records.tokens import Scope
from service.web.schemas.base import Id, Moment, Shape


class Session(Shape):
    """Who asks, and what they may."""

    name: str | None = Field(description="The token's name; it signs what is changed.")
    scopes: list[Scope]
    spacecraft: list[str] | None = Field(description="Those the token is bound to; null: all.")


class AuditRow(Shape):
    """One change."""

    id: Id
    moment: Moment
    who: str = Field(description="The token's name; `local` while access is open.")
    action: str = Field(description="The operation's name in this description.")
    about: str = Field(description="The path and query that were asked for.")
    body: str | None = Field(description="What was sent, its beginning where it is long.")
    status: int | None = Field(description="Of the answer; null for what was done by command.")


class AuditPage(Shape):
    """A page of changes."""

    items: list[AuditRow]
    next_cursor: str | None
