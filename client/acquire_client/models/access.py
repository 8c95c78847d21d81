"""Records of access: callers, tokens, and the audit list of changes."""
# Written by `make client` from service/contract/access.py.

from collections.abc import Sequence

from ..base import Model


class Session(Model, frozen=True, kw_only=True):
    """The caller of a request: name, scopes and spacecraft of its token."""

    name: str | None
    """Name of the token, which the audit list records with each change."""
    scopes: Sequence[str]
    spacecraft: Sequence[str] | None
    """Spacecraft that the token is limited to; None: all."""


class Token(Model, frozen=True, kw_only=True):
    """An access token without its secret; the service stores only a digest of the secret."""

    name: str
    """The audit list records changes under it; never used again."""
    scopes: Sequence[str]
    spacecraft: Sequence[str] | None
    """Spacecraft that the token is limited to; None: all."""
    rate_per_s: float | None
    """Requests per second; None: no limit."""
    created: str
    expires: str
    revoked: str | None
    state: str


class NewToken(Token, frozen=True, kw_only=True):
    """A new access token with its secret, which no other answer shows."""

    token: str
    """Sent as `Authorization: Bearer acq_...`."""


class TokenList(Model, frozen=True, kw_only=True):
    """All tokens, the oldest first."""

    items: Sequence[Token]
