"""The client: every part together."""

from collections.abc import Sequence

from .. import models
from ..encoding import decoded, path_of
from .batches import Batches
from .events import Events
from .operations import Alarms, Calibrations
from .replays import Replays
from .spacecraft import Gyro, Spacecraft


class Client(Batches, Spacecraft, Alarms, Replays, Gyro, Calibrations):
    """A client of the service at an address; a context manager that closes its connections.

    `token` is sent with each request.  A request that may be sent twice is sent again after a
    lost connection, and where the service asks for it, until the service has not answered for
    `give_up_after_s`.  `timeout_s` is how long one attempt may wait for the next part of an
    answer.  `trust_env` uses the proxies that the environment names; `verify` is the context of
    TLS, or False to trust every certificate.

    Raises `InvalidArgument`, a `ValueError`, for an address or a token that is none; every method
    raises `NoAnswer` and the `Problem` of the service's answer.
    """

    def session(self) -> models.Session:
        """The caller as the service knows it: the token's name, its scopes and spacecraft.

        Raises `Unauthenticated` where the service asks for a token, or for another one.

        >>> session = client.session()
        >>> session.scopes
        ['operate', 'read', 'submit']
        """
        return self.get(models.Session, path_of("session"))

    def tokens(self) -> Sequence[models.Token]:
        """Every token without its secret, the oldest first."""
        return (self.get(models.TokenList, path_of("tokens"))).items

    def create_token(
        self,
        name: str,
        scopes: Sequence[str],
        *,
        spacecraft: Sequence[str] | None = None,
        days: int = 365,
        rate_per_s: float | None = None,
    ) -> models.NewToken:
        """Make a token; its secret is in this answer alone.  The first one ends open access."""
        asked = {"name": name, "scopes": list(scopes), "days": days, "rate_per_s": rate_per_s}
        asked["spacecraft"] = None if spacecraft is None else list(spacecraft)
        return self.post(models.NewToken, path_of("tokens"), asked)

    def revoke_token(self, name: str) -> models.Token:
        """End a token at once, with the sessions that were begun with it; raises `NotFound`."""
        return decoded(self.request("DELETE", path_of("tokens", name)), models.Token)

    def events(
        self, *, run: str | None = None, spacecraft: str | None = None, after: int | None = None
    ) -> Events:
        """Live events from now on, or those after the event of that number.

        They are followed through lost connections and restarts of the service.  Raises
        `EventsLost` where the service no longer keeps all that were missed, `NoAnswer` where it
        does not come back for `give_up_after_s`.

        >>> for event in client.events(after=0):
        ...     if event.kind == "batches":
        ...         print(event.id, event.data.latest.batch)
        ...         break
        1 1996-010-0110
        """
        return Events(self, {"run": run, "spacecraft": spacecraft}, after)
