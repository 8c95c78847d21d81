"""Client methods: tokens."""
# Written by `make client` from service/web/api/tokens.py.

from collections.abc import Sequence

from .. import models
from ..calls import Call, items, model, single_request
from ..encoding import parameters_of, path_of


class TokensMethods:
    """Methods for the routes of `service/web/api/tokens.py` of the service."""

    @single_request
    def session(self) -> Call[models.Session]:
        """Name, scopes and spacecraft of the caller.

        >>> client.session().scopes
        ['operate', 'read', 'submit']
        """
        path = path_of("session")
        return Call(model(models.Session), "GET", path)

    @single_request
    def tokens(self) -> Call[list[models.Token]]:
        """All tokens, with scopes, spacecraft, expiry and state."""
        path = path_of("tokens")
        return Call(items(models.Token), "GET", path)

    @single_request
    def create_token(
        self,
        name: str,
        scopes: Sequence[str],
        *,
        spacecraft: Sequence[str] | None = None,
        days: int = 365,
        rate_per_s: float | None = None,
    ) -> Call[models.NewToken]:
        """Create an access token; the first one ends open access.

        - `name`: Of a program or a person. The audit list records changes under it.
        - `spacecraft`: Bind it to these; None: all.
        - `days`: Days until it expires.
        - `rate_per_s`: Requests per second; None: no limit.
        """
        path = path_of("tokens")
        body = {
            "name": name,
            "scopes": scopes,
            "spacecraft": spacecraft,
            "days": days,
            "rate_per_s": rate_per_s,
        }
        return Call(model(models.NewToken), "POST", path, body=parameters_of(body))

    @single_request
    def revoke_token(self, name: str) -> Call[models.Token]:
        """Revoke a token at once, with the browser sessions begun with it.

        - `name`: The `name` of a token.
        """
        path = path_of("tokens", name)
        return Call(model(models.Token), "DELETE", path)
