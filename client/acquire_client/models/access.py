"""Callers, tokens, and the audit list of what they changed."""
# Written by `make client` from service/contract/access.py.

from collections.abc import Sequence

from ..base import Model


class Session(Model, frozen=True, kw_only=True):
    """The caller and its scopes."""

    name: str | None
    """The token's name, which the audit list records with each change."""
    scopes: Sequence[str]
    spacecraft: Sequence[str] | None
    """Spacecraft that the token is bound to; None: all."""


class Token(Model, frozen=True, kw_only=True):
    """A token without its secret, of which only a digest is stored."""

    name: str
    """The audit list records changes under it; never used again."""
    scopes: Sequence[str]
    spacecraft: Sequence[str] | None
    """Spacecraft that the token is bound to; None: all."""
    rate_per_s: float | None
    """Requests per second; None: no limit."""
    created: str
    expires: str
    revoked: str | None
    state: str


class NewToken(Token, frozen=True, kw_only=True):
    """A new token with its secret, which is shown this once."""

    token: str
    """Sent as `Authorization: Bearer acq_...`."""


class TokenList(Model, frozen=True, kw_only=True):
    """All tokens, the oldest first."""

    items: Sequence[Token]
