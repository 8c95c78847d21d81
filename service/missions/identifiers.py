"""The registry of star identification methods: an entry makes a method available everywhere.

The types that check options and mission files, the OpenAPI schema, the console's form and the
command's choices are derived from it. An entry may name its function as `module:function`, which is
imported at its first use, since the registry must not import the identifiers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pkgutil import resolve_name
from typing import Any


@dataclass(frozen=True)
class IdentifierEntry:
    """A star identification method: name, function, and the properties that the pipeline uses.

    `function` takes a `Sighting` and returns an `Identification`; with `by_columns` it takes many
    sightings and writes the results into arrays, as `identify_by_votes` does.
    """

    name: str
    function: str | Callable[..., Any]
    description: str
    by_columns: bool = False
    weighs_hypotheses: bool = False
    """True if the method ranks hypotheses by probability, so that two groups can be separated."""
    uses_prior: bool = True
    """True if the method searches about the a priori attitude where one is known."""
    falls_back: bool = False
    """True if the whole sky is searched when the a priori attitude gives no good result."""
    needs_guide: bool = False
    """True if the method searches the whole sky itself, with the guide database of triangles."""
    uses: frozenset[str] | None = None
    """The tests and tolerances that affect the method's result; None means all of them.

    Other settings may still change the votes shown beside the result.
    """

    @cached_property
    def identify(self) -> Callable[..., Any]:
        """The method's function, imported if it is given by name."""
        function = self.function
        return resolve_name(function) if isinstance(function, str) else function

    @property
    def searches_zone(self) -> bool:
        """True if the identifier searches only the zone about an a priori attitude."""
        return self.uses_prior and not self.needs_guide


IDENTIFIERS: dict[str, IdentifierEntry] = {}
"""The registered identification methods by name, in display order."""


def register(entry: IdentifierEntry) -> None:
    """Add an identification method to the registry.

    Must be called before `missions.mission`, which derives types from the registry, is imported.
    Raises `ValueError` if the name is taken.
    """
    if entry.name in IDENTIFIERS:
        raise ValueError(f"there is an identifier {entry.name} already")
    IDENTIFIERS[entry.name] = entry


register(
    IdentifierEntry(
        "starid",
        "service.identify.voting.starid:identify_by_votes",
        "the votes of star pairs, Fink & Shoup's steps 1 to 10",
        by_columns=True,
    )
)
register(
    IdentifierEntry(
        "verified",
        "service.identify.hypotheses.verified:identify_verified",
        "a probability for every star, from weighed hypotheses of all of them",
        by_columns=True,
        weighs_hypotheses=True,
        falls_back=True,
        uses=frozenset({"pair_separation_max_deg"}),
    )
)
register(
    IdentifierEntry(
        "ptp",
        "service.identify.triangles.ptp:identify_ptp",
        "planar triangles in the whole sky; uses neither prior nor magnitudes",
        needs_guide=True,
        uses=frozenset(),
    )
)
register(
    IdentifierEntry(
        "lost_in_space",
        "service.identify.hypotheses.verified:identify_verified",
        "as verified, about an attitude that is found in the whole sky",
        by_columns=True,
        weighs_hypotheses=True,
        uses_prior=False,
        uses=frozenset({"pair_separation_max_deg"}),
    )
)
